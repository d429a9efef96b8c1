// The values of the pixel under the pointer, in all images of all scenes of the page at once.
const readout = document.getElementById('readout');
const columns = [...document.querySelectorAll('.column')];
let point = null;
let asked = 0;

function number(value) {
  if (value === null) return 'damaged';
  return value === 0 ? '0' : Math.abs(value) < 0.001 || Math.abs(value) >= 1e5 ? value.toExponential(2) : value.toPrecision(4);
}

function words(v) {
  const lit = v.lit_by === null ? 'damaged' : v.lit_by.length === 0 ? 'no spot' : v.lit_by.length > 8 ? `${v.lit_by.length} spots` : `spots ${v.lit_by.join(', ')}`;
  const what = v.label === null ? 'label damaged' : v.label === 0 ? 'nothing' : `${v.label_name ?? `label ${v.label}`} (object ${v.instance ?? 'damaged'})`;
  return `depth ${number(v.depth_m)} m · range ${number(v.range_m)} m · normal ${v.normal?.map((x) => x.toFixed(2)).join(' ') ?? 'damaged'} · ` +
    `${what}${v.mirror ? ', mirror' : ''} · light ${number(v.intensity)} · lit by ${lit}`;
}

async function ask() {
  const mine = ++asked;
  const { x, y } = point;
  const texts = await Promise.all(columns.map(async (column) => {
    const w = Number(column.dataset.width), h = Number(column.dataset.height);
    const at = [Math.min(h - 1, Math.floor(y * h)), Math.min(w - 1, Math.floor(x * w))];
    const reply = await fetch(`/bytes/value?${column.dataset.scene}&row=${at[0]}&column=${at[1]}`);
    if (!reply.ok) return `pixel ${at[1]}, ${at[0]}: the server does not answer`;
    return `column ${at[1]}, row ${at[0]}: ${words(await reply.json())}`;
  }));
  if (mine === asked) readout.textContent = texts.join('\n');
}

let waiting = false;
function move(x, y) {
  point = { x: Math.min(0.999999, Math.max(0, x)), y: Math.min(0.999999, Math.max(0, y)) };
  for (const frame of document.querySelectorAll('.frame')) {
    frame.classList.add('pointed');
    frame.querySelector('.cross.h').style.top = `${100 * point.y}%`;
    frame.querySelector('.cross.v').style.left = `${100 * point.x}%`;
  }
  if (waiting) return;
  waiting = true;
  setTimeout(() => { waiting = false; ask(); }, 40);
}

for (const frame of document.querySelectorAll('.frame')) {
  const column = frame.closest('.column');
  frame.addEventListener('pointermove', (event) => {
    const box = frame.getBoundingClientRect();
    move((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
  });
  frame.addEventListener('keydown', (event) => {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const step = steps[event.key];
    if (!step) return;
    event.preventDefault();
    const w = Number(column.dataset.width), h = Number(column.dataset.height);
    const from = point ?? { x: 0.5, y: 0.5 };
    move((Math.floor(from.x * w) + step[0] + 0.5) / w, (Math.floor(from.y * h) + step[1] + 0.5) / h);
  });
}
