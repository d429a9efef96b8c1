// A view from all sides, by pointer and keyboard. Points are in the camera's frame: x right, y down,
// z forward.
const { sin, cos, hypot, max, min, PI } = Math;
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const sum = (a, b, f = 1) => [a[0] + f * b[0], a[1] + f * b[1], a[2] + f * b[2]];
const unit = (a) => { const l = hypot(...a) || 1; return a.map((x) => x / l); };

const NEAR = 0.02, FAR = 500;
const STEEP = 0.49 * PI;

export class Orbit {
  /**
   * Takes the distance in metres at which the camera's own view turns, the direction that is upwards
   * in the room, and middle and size of what is there.
   */
  constructor(depth, up, { middle, size }, changed) {
    // A camera upside down is one whose world has another axis upwards.
    this.up = up && up[1] < 0 ? unit(up) : [0, -1, 0];
    this.forward = unit(sum([0, 0, 1], this.up, -this.up[2]));
    this.right = cross(this.forward, this.up);
    Object.assign(this, { depth, middle, size });
    this.changed = changed;
    this.field = 55 / 180 * PI;
    this.start();
  }

  /** The view at the beginning: from behind the camera, to the right and above. */
  start() {
    this.camera();
    this.yaw = 0.5;
    this.pitch = min(STEEP, max(0.3, this.pitch + 0.15));
    this.target = this.middle;
    this.distance = 2.6 * this.size;
  }

  /** The camera's own view. */
  camera() {
    this.target = [0, 0, this.depth];
    this.yaw = 0;
    this.pitch = Math.asin(max(-1, min(1, -this.up[2])));
    this.distance = this.depth;
  }

  /** The view as a text for the address, and back. */
  text() { return [this.yaw, this.pitch, this.distance, ...this.target].map((x) => x.toFixed(3)).join(','); }

  parse(text) {
    const all = text.split(',').map(Number);
    if (all.length !== 6 || !all.every(Number.isFinite) || all[2] <= 0) return;
    [this.yaw, this.pitch, this.distance] = all;
    this.target = all.slice(3);
  }

  eye() {
    const flat = sum(this.right.map((x) => sin(this.yaw) * x), this.forward, -cos(this.yaw));
    const away = sum(flat.map((x) => cos(this.pitch) * x), this.up, sin(this.pitch));
    return sum(this.target, away, this.distance);
  }

  axes() {
    const eye = this.eye();
    const ahead = unit(sum(this.target, eye, -1));
    const side = unit(cross(ahead, this.up));
    return { eye, ahead, side, above: cross(side, ahead) };
  }

  /** The matrix from points to clip space, by columns. */
  matrix(aspect) {
    const { eye, ahead, side, above } = this.axes();
    const rows = [[...side, -dot(side, eye)], [...above, -dot(above, eye)], [...ahead.map((x) => -x), dot(ahead, eye)]];
    const f = 1 / Math.tan(this.field / 2);
    // The field is that of the shorter side.
    const scale = aspect > 1 ? [f / aspect, f] : [f, f * aspect];
    const out = new Float32Array(16);
    for (let c = 0; c < 4; c++) {
      out[4 * c] = scale[0] * rows[0][c];
      out[4 * c + 1] = scale[1] * rows[1][c];
      out[4 * c + 2] = (FAR + NEAR) / (NEAR - FAR) * rows[2][c] + (c === 3 ? 2 * FAR * NEAR / (NEAR - FAR) : 0);
      out[4 * c + 3] = -rows[2][c];
    }
    return out;
  }

  turn(x, y) {
    this.yaw -= x;
    this.pitch = max(-STEEP, min(STEEP, this.pitch + y));
    this.changed();
  }

  move(x, y) {
    const { side, above } = this.axes();
    this.target = sum(sum(this.target, side, -x * this.distance), above, y * this.distance);
    this.changed();
  }

  zoom(factor) {
    this.distance = max(0.05, min(100, this.distance * factor));
    this.changed();
  }

  /** Turns by a key; returns whether the key has a meaning. */
  key(event) {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (way && event.shiftKey) this.move(-0.05 * way[0], -0.05 * way[1]);
    else if (way) this.turn(-0.1 * way[0], -0.1 * way[1]);
    else if (event.key === '+' || event.key === '=') this.zoom(0.9);
    else if (event.key === '-') this.zoom(1 / 0.9);
    else if (event.key === 'Home') { this.camera(); this.changed(); }
    else if (event.key === 'End') { this.start(); this.changed(); }
    else return false;
    return true;
  }
}

/**
 * Turns what `orbit()` returns, or nothing while that is null, by the pointers on an element. A press
 * without a move calls `click`; the end of each change calls `done`.
 */
export function follow(element, orbit, click, done) {
  const pointers = new Map();
  let moved = false;
  element.addEventListener('pointerdown', (event) => {
    if (!orbit() || event.button > 2) return;
    if (pointers.size === 0) moved = false;
    pointers.set(event.pointerId, [event.clientX, event.clientY, event.clientX, event.clientY]);
    element.setPointerCapture(event.pointerId);
  });
  element.addEventListener('pointermove', (event) => {
    const place = pointers.get(event.pointerId);
    if (!place || !orbit()) return;
    const [x0, y0, startX, startY] = place;
    const [dx, dy] = [event.clientX - x0, event.clientY - y0];
    // A trembling finger is no drag.
    if (!moved && hypot(event.clientX - startX, event.clientY - startY) < 5) return;
    moved = true;
    pointers.set(event.pointerId, [event.clientX, event.clientY, startX, startY]);
    const size = element.clientHeight || 1;
    if (pointers.size === 2) {
      const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, p]) => p);
      const before = hypot(x0 - other[0], y0 - other[1]), after = hypot(event.clientX - other[0], event.clientY - other[1]);
      if (before > 0 && after > 0) orbit().zoom(before / after);
      orbit().move(dx / size / 2, dy / size / 2);
    } else if (event.shiftKey || event.buttons & 6) orbit().move(dx / size, dy / size);
    else orbit().turn(4 * dx / size, 4 * dy / size);
  });
  const end = (event) => {
    if (!pointers.delete(event.pointerId)) return;
    if (!moved && event.type === 'pointerup' && event.button === 0 && orbit()) click(event);
    if (pointers.size === 0) done();
  };
  element.addEventListener('pointerup', end);
  element.addEventListener('pointercancel', end);
  element.addEventListener('contextmenu', (event) => { if (orbit()) event.preventDefault(); });
  // Without focus the wheel scrolls the page.
  element.addEventListener('wheel', (event) => {
    if (!orbit() || !element.contains(document.activeElement)) return;
    event.preventDefault();
    orbit().zoom(2 ** (event.deltaY / 400));
    done();
  }, { passive: false });
}

/** Returns the middle of points, each of three numbers, and their mean distance from it. */
export function extent(points) {
  const middle = [0, 0, 0];
  for (const p of points) for (let k = 0; k < 3; k++) middle[k] += p[k] / points.length;
  const size = points.reduce((all, p) => all + hypot(...sum(p, middle, -1)) / points.length, 0);
  return { middle, size: max(0.1, size) };
}

/** Returns where a point is on a picture of a size, in its pixels; null behind the viewer. */
export function project(m, [x, y, z], width, height) {
  const w = m[3] * x + m[7] * y + m[11] * z + m[15];
  if (w <= NEAR) return null;
  const u = (m[0] * x + m[4] * y + m[8] * z + m[12]) / w, v = (m[1] * x + m[5] * y + m[9] * z + m[13]) / w;
  return [(0.5 + 0.5 * u) * width, (0.5 - 0.5 * v) * height, w];
}

/** Draws the camera as a pyramid, and the laser as a star. `lens` is fx, fy, cx, cy of its image. */
export function drawCamera(c, m, { lens, size, laser }, [width, height], scale = 0.3) {
  const line = (a, b, colour) => {
    const [p, q] = [project(m, a, width, height), project(m, b, width, height)];
    if (!p || !q) return;
    for (const [stroke, wide] of [['#000a', 3], [colour, 1.5]]) {
      c.strokeStyle = stroke; c.lineWidth = wide;
      c.beginPath(); c.moveTo(p[0], p[1]); c.lineTo(q[0], q[1]); c.stroke();
    }
  };
  const corner = (x, y) => [scale * (x - lens[2]) / lens[0], scale * (y - lens[3]) / lens[1], scale];
  const corners = [corner(0, 0), corner(size[0], 0), corner(size[0], size[1]), corner(0, size[1])];
  corners.forEach((a, i) => { line([0, 0, 0], a, '#4cc9f0'); line(a, corners[(i + 1) % 4], '#4cc9f0'); });
  const name = (at, text, dy) => {
    const p = project(m, at, width, height);
    if (!p) return;
    c.font = '11px system-ui, sans-serif';
    c.lineWidth = 3; c.strokeStyle = '#000b'; c.strokeText(text, p[0] + 7, p[1] + dy);
    c.fillStyle = '#fff'; c.fillText(text, p[0] + 7, p[1] + dy);
  };
  const shared = !laser || hypot(...laser) < 0.02;
  name([0, 0, 0], shared && laser ? 'camera and laser' : 'camera', 4);
  if (laser && !shared) {
    const r = 0.06;
    for (const axis of [[r, 0, 0], [0, r, 0], [0, 0, r]]) line(sum(laser, axis, -1), sum(laser, axis), '#ff5d5d');
    name(laser, 'laser', -6);
  }
}
