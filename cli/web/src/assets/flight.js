// The player of light in flight: controls, keys, loading, the picked pixel and its histogram.
import { Volume } from './volume.js';
import { Histogram, fit } from './histogram.js';
import { Orbit, follow } from './orbit.js';
import { imageMarks } from './marks.js';
import { Space } from './space.js';
import { Recorder, saveBlob, savePng } from './save.js';

const METRES_PER_NS = 0.299792458;
const SLAB = 32;
const $ = (id) => document.getElementById(id);
const root = $('flight');
const scene = root.dataset.scene;
let light = root.dataset.light;
let facts = null, found = null, spots = [], volume = null, histogram = null, energy = [];
let playing = false, time = 0, picked = null, dirty = true, turn = 0;
let space = null, orbit = null, inSpace = false, recorder = null;

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
if (asked.get('surface') === 'no') $('surface').checked = false;
inSpace = asked.get('view') === 'space';
// An address may name a choice that is not on the list.
for (const id of ['scale', 'map']) if ($(id).selectedIndex < 0) $(id).selectedIndex = 0;

function address() {
  const now = new URLSearchParams(scene);
  now.set('light', light);
  for (const [name, id] of Object.entries(KEPT)) now.set(name, $(id).value);
  if ($('spots').checked) now.set('spots', 'yes');
  if (picked) now.set('pixel', picked.join(','));
  if (inSpace) {
    now.set('view', 'space');
    if (orbit) now.set('orbit', orbit.text());
    if (!$('surface').checked) now.set('surface', 'no');
  }
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
  // At the surfaces, time is that of the light before its way to the camera.
  const way = space && inSpace && $('surface').checked ? space.middle : 0;
  const ns = (facts.start_m + time * facts.bin_m - way) / METRES_PER_NS;
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
  const shown = { spots: $('spots').checked ? spots : [], picked, light };
  if (!inSpace) imageMarks(c, width, height, facts, shown);
  else space?.marks(c, width, height, shown);
}

// Light over time, below the slider: the middle of its thumb is at the same place.
const THUMB = 14;
const along = (bin, width) => THUMB / 2 + bin / Math.max(1, facts.bins - 1) * (width - THUMB);
function strip() {
  const { context: c, width, height } = fit($('energy'));
  const style = getComputedStyle(document.documentElement);
  const most = Math.max(...energy, 1e-30);
  c.fillStyle = style.getPropertyValue('--more');
  energy.forEach((e, b) => {
    const tall = Math.sqrt(e / most) * (height - 2);
    c.fillRect(along(b, width), height - tall, Math.max(0.75, along(1, width) - along(0, width)), tall);
  });
  c.fillStyle = style.getPropertyValue('--accent');
  c.fillRect(along(time, width) - 1, 0, 2, height);
}

// The picture of the room in space has the pixels of the screen, that of the image its own.
function resize() {
  const view = $('view');
  let [w, h] = [facts.width, facts.height];
  if (inSpace && space) {
    const wide = Math.min(1600, Math.round($('screen').clientWidth * Math.min(2, devicePixelRatio || 1)));
    [w, h] = [wide, Math.round(wide * facts.height / facts.width)];
  }
  if (w > 0 && (view.width !== w || view.height !== h)) { view.width = w; view.height = h; }
}

function draw() {
  if (!volume) return;
  resize();
  if (inSpace && space) space.draw(settings(), orbit, $('surface').checked);
  else volume.draw(settings());
  marks();
  strip();
  recorder?.frame();
  texts();
  histogram.draw({ log: $('hlog').checked, zoom: $('zoom').checked, time: time + later(), shutter: Number($('shutter').value) });
}

// At the surfaces, light of the picked pixel that is seen now arrives this many bins later.
function later() {
  if (!inSpace || !space || !picked || !$('surface').checked) return 0;
  const i = picked[1] * facts.width + picked[0];
  return space.depth[i] > 0 ? (Math.hypot(...space.point(i)) - space.middle) / facts.bin_m : 0;
}

// A frame only where something changed.
let before = null, counted = 0, since = 0;
function frame(now) {
  if (playing && before !== null) {
    const next = time + rate() * Math.min(0.1, (now - before) / 1000);
    if (recorder && next > facts.lively[1]) record();
    else seek(next, true);
  }
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
    $('seen').replaceChildren(...histogram.seen().map((line) => Object.assign(document.createElement('p'), { textContent: line })));
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
    const [answer, small] = await both;
    if (mine !== turn) return;
    const first = !facts;
    facts = answer.volume;
    found = answer.scene;
    spots = found.spots;
    energy = facts.energy;
    if (volume) volume.gl.getExtension('WEBGL_lose_context') && replaceCanvas();
    volume = new Volume($('view'), facts);
    volume.setSmall(small);
    histogram = new Histogram($('histogram'), facts);
    space = null;
    const bin = Number(asked.get('bin'));
    if (first) seek(asked.has('bin') && Number.isFinite(bin) ? bin : facts.lively[0] + (facts.lively[1] - facts.lively[0]) / 4);
    draw();
    document.documentElement.dataset.flight = 'small';
    document.documentElement.dataset.first = Math.round(performance.now() - began);
    $('loaded').textContent = `first picture after ${Math.round(performance.now() - began)} ms; loading all pixels…`;
    if (picked) pick(...picked);
    if (inSpace) await enter();
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

// The room in space needs the depth, which is asked for once.
let depth = null;
async function enter() {
  inSpace = true;
  show();
  // The volume enters when it has arrived.
  if (!volume) return;
  const mine = turn;
  try {
    depth ??= get('depth').then((r) => r.arrayBuffer());
    const values = new Float32Array(await depth);
    if (mine !== turn || !inSpace) return;
    if (!space) {
      space = new Space(volume, values, found);
      orbit ??= looking();
    }
    document.documentElement.dataset.view = 'space';
  } catch (error) {
    depth = null;
    inSpace = false;
    $('message').textContent = `Only the image is shown: ${error.message}`;
    $('message').hidden = false;
  }
  show();
}

function looking() {
  const made = new Orbit(space.middle, found.up, space.extent, touch);
  if (asked.has('orbit')) made.parse(asked.get('orbit'));
  return made;
}

function leave() {
  inSpace = false;
  document.documentElement.dataset.view = 'image';
  show();
}

function show() {
  $('image').setAttribute('aria-pressed', String(!inSpace));
  $('space').setAttribute('aria-pressed', String(inSpace));
  $('surface').closest('label').hidden = !inSpace;
  $('how').textContent = inSpace ? 'Drag or the arrow keys turn the room; Shift or two fingers move it; the wheel, + and − go closer and away; Home is the camera.' : '';
  $('screen').classList.toggle('space', inSpace);
  keep();
  touch();
}

const layers = () => [$('view'), $('marks')];
const named = (kind) => `light-in-flight-${$('clock').textContent.split(' ')[0]}ns.${kind}`;
const say = (text) => { $('saved').textContent = text; };

async function attempt(work) {
  if (!volume) return;
  try { await work(); } catch (error) { say(`Not saved: ${error.message}.`); }
}

const png = () => attempt(async () => { draw(); await savePng(layers(), named('png')); say('Saved the picture.'); });

// The server makes these, with the look of the player.
const fetched = (what, kind) => attempt(async () => {
  say(`Making the ${kind.toUpperCase()}…`);
  const look = new URLSearchParams(address().split('?')[1]);
  const more = ['bin', 'shutter', 'exposure', 'scale', 'map', 'pixel'].filter((name) => look.has(name));
  const reply = await get(what, more.map((name) => `&${name}=${encodeURIComponent(look.get(name))}`).join(''));
  saveBlob(await reply.blob(), named(kind));
  say(`Saved the ${kind.toUpperCase()}.`);
});

// Plays from the first light to most of it and records that.
const record = () => attempt(async () => {
  if (recorder) {
    const last = recorder;
    recorder = null;
    play(false);
    $('record').textContent = 'Record WebM';
    await last.stop();
    say('Saved the video.');
    return;
  }
  seek(facts.lively[0]);
  draw();
  recorder = new Recorder(layers, named('webm'));
  $('record').textContent = 'Stop recording';
  say('Recording…');
  play(true);
});

$('play').addEventListener('click', () => play());
$('time').addEventListener('input', () => { playing && play(false); seek(Number($('time').value)); });
$('time').addEventListener('change', keep);
$('controls').addEventListener('submit', (event) => event.preventDefault());
$('controls').addEventListener('input', (event) => {
  if (event.target.id !== 'light') { touch(); keep(); }
});
$('light').addEventListener('change', () => { light = $('light').value; keep(); load(); });
for (const id of ['hlog', 'zoom']) $(id).addEventListener('input', touch);
$('export').addEventListener('click', png);
$('record').addEventListener('click', record);
$('gif').addEventListener('click', () => fetched('gif', 'gif'));
$('figure').addEventListener('click', () => fetched('figure', 'svg'));
$('image').addEventListener('click', leave);
$('space').addEventListener('click', enter);
$('surface').addEventListener('input', () => { keep(); touch(); });
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
  if (!facts || inSpace || event.button !== 0) return;
  const box = $('view').getBoundingClientRect();
  const [u, v] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  if ($('spots').checked && pickSpot(u, v)) return;
  pick(Math.floor(u * facts.width), Math.floor(v * facts.height));
});
follow($('screen'), () => (inSpace && space ? orbit : null), (event) => {
  const box = $('view').getBoundingClientRect();
  const at = space.pick(event.clientX - box.left, event.clientY - box.top, box.width, box.height);
  if (at) pick(...at);
}, keep);

// Scrubs with a pointer, also a finger.
function scrub(element, bin) {
  const move = (event) => {
    if (!facts) return;
    playing && play(false);
    seek(bin(event.clientX - element.getBoundingClientRect().left));
  };
  element.addEventListener('pointerdown', (event) => {
    if (event.button !== 0) return;
    element.setPointerCapture(event.pointerId);
    move(event);
  });
  element.addEventListener('pointermove', (event) => { if (element.hasPointerCapture(event.pointerId)) move(event); });
  element.addEventListener('pointerup', keep);
}
scrub($('histogram'), (x) => histogram?.pixel ? histogram.binAt(x, $('zoom').checked) - later() : time);
scrub($('energy'), (x) => (x - THUMB / 2) / Math.max(1, $('energy').clientWidth - THUMB) * (facts.bins - 1));
addEventListener('keydown', (event) => {
  if (!facts || event.ctrlKey || event.metaKey || event.altKey) return;
  const inField = event.target.closest('input, select, button, a');
  const step = { ',': -1, '.': 1, '<': -10, '>': 10 }[event.key];
  if (event.key === ' ' && !event.target.closest('select, button, a, input[type=checkbox]')) { event.preventDefault(); play(); return; }
  if (step && !inField) { playing && play(false); seek(Math.round(time) + step); return; }
  const act = { 2: leave, 3: enter, s: png, r: record, g: () => fetched('gif', 'gif'), f: () => fetched('figure', 'svg') }[event.key];
  if (act && (!inField || event.target.matches('button, input[type=range]'))) { act(); return; }
  if (event.target !== $('screen')) return;
  if (inSpace) { if (orbit?.key(event)) { event.preventDefault(); keep(); } return; }
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
