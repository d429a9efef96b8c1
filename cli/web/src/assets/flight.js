// The player of light in flight: controls, keys, loading, the picked pixel and its histogram.
import { Volume } from './volume.js';
import { Histogram, fit } from './histogram.js';

const METRES_PER_NS = 0.299792458;
const SLAB = 32;
const $ = (id) => document.getElementById(id);
const root = $('flight');
const scene = root.dataset.scene;
let light = root.dataset.light;
let facts = null, spots = [], volume = null, histogram = null, energy = [];
let playing = false, time = 0, picked = null, dirty = true, turn = 0;

function fail(text) {
  $('message').textContent = text;
  $('message').hidden = false;
  $('loaded').textContent = '';
  document.documentElement.dataset.flight = 'failed';
}

async function get(what, more = '') {
  const reply = await fetch(`/bytes/${what}?${scene}&light=${light}${more}`);
  if (!reply.ok) {
    const page = new DOMParser().parseFromString(await reply.text(), 'text/html');
    throw new Error(page.querySelector('.problem p')?.textContent ?? `the server answers ${reply.status}`);
  }
  return reply;
}

// The address keeps the picked pixel, the time and the settings, so that it can be shared.
const KEPT = { scale: 'scale', map: 'map', exposure: 'exposure', shutter: 'shutter', speed: 'speed', room: 'room' };
const asked = new URLSearchParams(location.search);
for (const [name, id] of Object.entries(KEPT)) if (asked.has(name)) $(id).value = asked.get(name);
if (asked.get('pixel')?.match(/^\d+,\d+$/)) picked = asked.get('pixel').split(',').map(Number);
for (const name of ['spots']) if (asked.get(name) === 'yes') $(name).checked = true;

function address() {
  const now = new URLSearchParams(scene);
  now.set('light', light);
  for (const [name, id] of Object.entries(KEPT)) now.set(name, $(id).value);
  if ($('spots').checked) now.set('spots', 'yes');
  if (picked) now.set('pixel', picked.join(','));
  now.set('bin', time.toFixed(1));
  return `${location.pathname}?${now}`;
}

const keep = () => history.replaceState(null, '', address());

const settings = () => ({
  time,
  shutter: Number($('shutter').value),
  gain: 2 ** Number($('exposure').value) / facts.white,
  scale: ['linear', 'root', 'log'].indexOf($('scale').value),
  map: Number($('map').value),
  ambient: Number($('room').value),
});

function touch() { dirty = true; }

function seek(bin, wrap = false) {
  const [lo, hi] = facts.lively;
  if (wrap && bin > hi) bin = lo;
  time = Math.min(facts.bins - 1, Math.max(0, bin));
  touch();
}

function texts() {
  const ns = (facts.start_m + time * facts.bin_m) / METRES_PER_NS;
  $('clock').textContent = `${ns.toFixed(2)} ns · ${(ns * METRES_PER_NS).toFixed(2)} m`;
  $('time').value = time;
  $('time').setAttribute('aria-valuetext', `${ns.toFixed(2)} nanoseconds`);
  const bins = Number($('shutter').value);
  $('bins').textContent = `${bins} bin${bins > 1 ? 's' : ''}, ${(bins * facts.bin_m / METRES_PER_NS * 1000).toFixed(0)} ps`;
  $('rate').textContent = `${(rate() * facts.bin_m / METRES_PER_NS).toFixed(2)} ns/s`;
}

// Bins a second: the lively part in eight seconds at speed 0.
const rate = () => (facts.lively[1] - facts.lively[0]) / 8 * 2 ** Number($('speed').value);

function marks() {
  const { context: c, width, height } = fit($('marks'));
  const sx = width / facts.width, sy = height / facts.height;
  if ($('spots').checked) {
    c.font = '10px system-ui, sans-serif';
    spots.forEach((spot, i) => {
      if (!spot?.film) return;
      const [x, y] = [spot.film[0] * sx, spot.film[1] * sy];
      c.strokeStyle = '#000a'; c.lineWidth = 3; ring(c, x, y, 5);
      c.strokeStyle = light === `spot-${i}` ? '#fff' : '#ffb454'; c.lineWidth = 1.5; ring(c, x, y, 5);
      c.fillStyle = '#fff';
      c.fillText(String(i), x + 7, y + 3);
    });
  }
  if (picked) {
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
}

function ring(c, x, y, r) { c.beginPath(); c.arc(x, y, r, 0, 2 * Math.PI); c.stroke(); }

// Light over time, with the time that is shown.
function strip() {
  const { context: c, width, height } = fit($('energy'));
  const style = getComputedStyle(document.documentElement);
  const most = Math.max(...energy, 1e-30);
  c.fillStyle = style.getPropertyValue('--more');
  energy.forEach((e, b) => {
    const tall = Math.sqrt(e / most) * (height - 2);
    c.fillRect(b / facts.bins * width, height - tall, Math.max(0.75, width / facts.bins), tall);
  });
  c.fillStyle = style.getPropertyValue('--accent');
  c.fillRect(time / (facts.bins - 1) * width - 1, 0, 2, height);
}

function draw() {
  if (!volume) return;
  volume.draw(settings());
  marks();
  strip();
  texts();
  histogram.draw({ log: $('hlog').checked, zoom: $('zoom').checked, time, shutter: Number($('shutter').value) });
}

// A frame only where something changed.
let before = null, counted = 0, since = 0;
function frame(now) {
  if (playing && before !== null) seek(time + rate() * Math.min(0.1, (now - before) / 1000), true);
  before = now;
  if (dirty) { dirty = false; draw(); counted++; }
  if (now - since > 1000) {
    $('fps').textContent = playing ? `${Math.round(counted * 1000 / (now - since))} frames/s` : '';
    counted = 0; since = now;
  }
  requestAnimationFrame(frame);
}

function play(on = !playing) {
  playing = on;
  $('play').textContent = on ? 'Pause' : 'Play';
  if (!on) keep();
  touch();
}

let picking = 0;
async function pick(column, row) {
  picked = [Math.min(facts.width - 1, Math.max(0, column)), Math.min(facts.height - 1, Math.max(0, row))];
  touch();
  const mine = ++picking;
  try {
    const found = await (await get('pixel', `&row=${picked[1]}&column=${picked[0]}`)).json();
    if (mine !== picking) return;
    histogram.set(found);
    $('kinds').hidden = !found.whole;
    const v = found.values;
    $('picked').textContent = `Column ${picked[0]}, row ${picked[1]}: ${v.label_name ?? 'nothing'}, ${v.range_m?.toFixed(2) ?? '?'} m · ${histogram.words()}`;
    $('histogram').setAttribute('aria-label', $('picked').textContent);
    document.documentElement.dataset.picked = picked.join(',');
    keep();
  } catch (error) {
    $('picked').textContent = `No histogram: ${error.message}`;
  }
  touch();
}

async function load() {
  const mine = ++turn;
  const began = performance.now();
  document.documentElement.dataset.flight = 'loading';
  $('message').hidden = true;
  $('loaded').textContent = 'loading…';
  const image = new Image();
  image.src = `/bytes/picture?${scene}&what=rgb`;
  try {
    const both = Promise.all([get('flight').then((r) => r.json()), get('coarse').then((r) => r.arrayBuffer())]);
    const [found, small] = await both;
    if (mine !== turn) return;
    const first = !facts;
    facts = found.volume;
    spots = found.scene.spots;
    energy = facts.energy;
    if (volume) volume.gl.getExtension('WEBGL_lose_context') && replaceCanvas();
    volume = new Volume($('view'), facts);
    volume.setSmall(small);
    histogram = new Histogram($('histogram'), facts);
    const bin = Number(asked.get('bin'));
    if (first) seek(asked.has('bin') && Number.isFinite(bin) ? bin : facts.lively[0] + (facts.lively[1] - facts.lively[0]) / 4);
    draw();
    document.documentElement.dataset.flight = 'small';
    document.documentElement.dataset.first = Math.round(performance.now() - began);
    $('loaded').textContent = `first picture after ${Math.round(performance.now() - began)} ms; loading all pixels…`;
    if (picked) pick(...picked);
    await image.decode().catch(() => null);
    if (mine !== turn) return;
    if (image.naturalWidth) { volume.setRoom(image); touch(); }
    await slabs(mine, began);
  } catch (error) {
    if (mine === turn) fail(error.message);
  }
}

// A context cannot give its textures back at once; a new canvas can.
function replaceCanvas() {
  volume.gl.getExtension('WEBGL_lose_context').loseContext();
  const old = $('view'), fresh = old.cloneNode();
  old.replaceWith(fresh);
}

// The slabs from the shown time on first, then those before.
async function slabs(mine, began) {
  if (!volume.hasFull) { $('loaded').textContent = 'a reduced picture: the graphics card takes no larger volume'; return; }
  const all = [];
  for (let from = 0; from < facts.bins; from += SLAB) all.push(from);
  let done = 0;
  while (all.length) {
    const next = all.findIndex((from) => from + SLAB > time);
    const two = all.splice(next < 0 ? 0 : next, 2);
    const parts = await Promise.all(two.map(async (from) => {
      const to = Math.min(facts.bins, from + SLAB);
      return [from, to, await (await get('slab', `&from=${from}&to=${to}`)).arrayBuffer()];
    }));
    if (mine !== turn) return;
    for (const [from, to, bytes] of parts) { volume.setSlab(from, to - from, bytes); done += to - from; }
    $('loaded').textContent = `${Math.round(100 * done / facts.bins)} % of all pixels`;
    touch();
  }
  const bytes = 2 * facts.width * facts.height * facts.bins;
  const size = bytes < 1e6 ? `${(bytes / 1e3).toFixed(0)} kB` : `${(bytes / 1e6).toFixed(bytes < 1e7 ? 1 : 0)} MB`;
  $('loaded').textContent = `first picture after ${document.documentElement.dataset.first} ms, all ${size} after ${Math.round(performance.now() - began)} ms`;
  document.documentElement.dataset.flight = 'full';
}

function save() {
  if (!volume) return;
  const times = Math.max(1, Math.round(768 / facts.width));
  const canvas = document.createElement('canvas');
  canvas.width = facts.width * times;
  canvas.height = facts.height * times;
  const c = canvas.getContext('2d');
  c.imageSmoothingEnabled = false;
  volume.draw(settings());
  c.drawImage($('view'), 0, 0, canvas.width, canvas.height);
  c.drawImage($('marks'), 0, 0, canvas.width, canvas.height);
  canvas.toBlob((blob) => {
    const link = document.createElement('a');
    link.href = URL.createObjectURL(blob);
    link.download = `light-in-flight-${(time * facts.bin_m / METRES_PER_NS + facts.start_m / METRES_PER_NS).toFixed(2)}ns.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  });
}

$('play').addEventListener('click', () => play());
$('time').addEventListener('input', () => { playing && play(false); seek(Number($('time').value)); });
$('time').addEventListener('change', keep);
$('controls').addEventListener('submit', (event) => event.preventDefault());
$('controls').addEventListener('input', (event) => {
  if (event.target.id !== 'light') { touch(); keep(); }
});
$('light').addEventListener('change', () => { light = $('light').value; keep(); load(); });
for (const id of ['hlog', 'zoom']) $(id).addEventListener('input', touch);
$('export').addEventListener('click', save);
$('link').addEventListener('click', async () => {
  keep();
  try {
    await navigator.clipboard.writeText(location.href);
    $('link').textContent = 'Copied';
  } catch { $('link').textContent = 'See address bar'; }
  setTimeout(() => { $('link').textContent = 'Copy link'; }, 1500);
});
// With marks of the spots, a click on one selects its light, where that is stored.
function pickSpot(u, v) {
  const away = (spot) => spot?.film ? Math.hypot(spot.film[0] / facts.width - u, spot.film[1] / facts.height - v) : Infinity;
  const all = spots.map(away), near = Math.min(...all);
  const name = `spot-${all.indexOf(near)}`;
  if (near > 0.02 || ![...$('light').options].some((option) => option.value === name)) return false;
  $('light').value = light = name;
  keep();
  load();
  return true;
}

$('screen').addEventListener('pointerdown', (event) => {
  if (!facts || event.button !== 0) return;
  const box = $('view').getBoundingClientRect();
  const [u, v] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  if ($('spots').checked && pickSpot(u, v)) return;
  pick(Math.floor(u * facts.width), Math.floor(v * facts.height));
});
$('histogram').addEventListener('pointerdown', (event) => {
  if (!histogram?.pixel) return;
  playing && play(false);
  seek(histogram.binAt(event.offsetX, $('zoom').checked));
});
$('energy').addEventListener('pointerdown', (event) => {
  if (!facts) return;
  playing && play(false);
  seek(event.offsetX / $('energy').clientWidth * facts.bins);
});
addEventListener('keydown', (event) => {
  if (!facts || event.ctrlKey || event.metaKey || event.altKey) return;
  const inField = event.target.closest('input, select, button, a');
  const step = { ',': -1, '.': 1, '<': -10, '>': 10 }[event.key];
  if (event.key === ' ' && !event.target.closest('select, button, a, input[type=checkbox]')) { event.preventDefault(); play(); return; }
  if (step && !inField) { playing && play(false); seek(Math.round(time) + step); return; }
  if (event.target !== $('screen')) return;
  const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  if (!move) return;
  event.preventDefault();
  const from = picked ?? [Math.floor(facts.width / 2), Math.floor(facts.height / 2)];
  const far = event.shiftKey ? 8 : 1;
  pick(from[0] + far * move[0], from[1] + far * move[1]);
});
new ResizeObserver(touch).observe($('screen'));
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', touch);
requestAnimationFrame(frame);
load();
