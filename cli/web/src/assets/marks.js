// The spots and the picked pixel over an image.
function ring(c, x, y, r) { c.beginPath(); c.arc(x, y, r, 0, 2 * Math.PI); c.stroke(); }

/** Draws them on a canvas of a size in CSS pixels. */
export function imageMarks(c, width, height, facts, { spots, picked, light }) {
  const sx = width / facts.width, sy = height / facts.height;
  c.font = '10px system-ui, sans-serif';
  spots.forEach((spot, i) => {
    if (!spot?.film) return;
    const [x, y] = [spot.film[0] * sx, spot.film[1] * sy];
    c.strokeStyle = '#000a'; c.lineWidth = 3; ring(c, x, y, 5);
    c.strokeStyle = light === `spot-${i}` ? '#fff' : '#ffb454'; c.lineWidth = 1.5; ring(c, x, y, 5);
    c.fillStyle = '#fff';
    c.fillText(String(i), x + 7, y + 3);
  });
  if (!picked) return;
  const [x, y] = [(picked[0] + 0.5) * sx, (picked[1] + 0.5) * sy];
  for (const [colour, wide] of [['#000b', 4], ['#4cc9f0', 1.5]]) {
    c.strokeStyle = colour; c.lineWidth = wide;
    c.beginPath();
    for (const [dx, dy] of [[-1, 0], [1, 0], [0, -1], [0, 1]]) {
      c.moveTo(x + 4 * dx, y + 4 * dy); c.lineTo(x + 12 * dx, y + 12 * dy);
    }
    c.stroke();
  }
}
