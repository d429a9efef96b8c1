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

// Whether the light agrees with the geometry. Reading the histograms takes a moment.
function facts(p) {
  const percent = (x, digits = 1) => `${(100 * x).toFixed(digits)} %`;
  const list = [];
  if (p.shares) {
    const [one, two, more] = p.shares.map((share) => percent(share));
    list.push(['energy', p.rendered_apart ? `one bounce ${one}, two ${two}, three and more ${more}, rendered apart`
      : `${one} at times of one bounce, ${two} at times of two, ${more} at others`]);
  }
  if (p.peak_bins !== null) list.push(['two-bounce peaks', `${Math.abs(p.peak_bins).toFixed(2)} bins (${Math.abs(1000 * p.peak_m).toFixed(1)} mm) ${p.peak_bins < 0 ? 'before' : 'after'} their predicted times, ` +
    `${p.pairs} pairs of pixel and spot`]);
  if (p.contrast !== null) list.push(['brightness there', `${p.contrast.toFixed(2)} times that of other times`]);
  if (p.early !== null) list.push(['light too early', `in ${percent(p.early, 2)} of the pixels`]);
  const e = p.error;
  if (e?.median_relative !== undefined) list.push(['stated error', `median of a pixel ${percent(e.median_relative)}` +
    (e.p95_relative === undefined ? '' : `, 95 of 100 pixels below ${percent(e.p95_relative)}`)]);
  if (typeof p.outside === 'number') list.push(['light outside of the gate', percent(p.outside, 2)]);
  list.push(['coding', `${p.coding_rms_sigma.toFixed(3)} of the photon noise`]);
  return list;
}

async function compare(section) {
  const line = section.querySelector('p');
  try {
    const reply = await fetch(`/bytes/physics?${section.dataset.physics}`);
    if (!reply.ok) {
      const page = new DOMParser().parseFromString(await reply.text(), 'text/html');
      throw new Error(page.querySelector('.problem p')?.textContent ?? `the server answers ${reply.status}`);
    }
    const p = await reply.json();
    const verdict = document.createElement('b');
    verdict.textContent = p.verdict;
    verdict.className = { agrees: 'good', 'does not agree': 'bad' }[p.verdict] ?? '';
    line.replaceChildren(verdict, p.reasons.length ? `: ${p.reasons.join('; ')}` : '');
    const list = document.createElement('dl');
    list.className = 'facts-list';
    for (const [name, value] of facts(p)) {
      const [dt, dd] = [document.createElement('dt'), document.createElement('dd')];
      [dt.textContent, dd.textContent] = [name, value];
      list.append(dt, dd);
    }
    section.append(list);
    section.dataset.verdict = p.verdict;
  } catch (error) {
    line.textContent = `Not compared: ${error.message}`;
    section.dataset.verdict = 'failed';
  }
}
for (const section of document.querySelectorAll('[data-physics]')) compare(section);
