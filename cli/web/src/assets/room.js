// The page of a reconstruction in 3D.
import { context } from './gl.js';
import { readGlb } from './glb.js';
import { fit } from './histogram.js';
import { Mesh } from './mesh.js';
import { Orbit, drawCamera, extent, follow } from './orbit.js';
import { savePng } from './save.js';

const $ = (id) => document.getElementById(id);
const { room, source } = $('room').dataset;
const asked = new URLSearchParams(location.search);
let mesh = null, orbit = null, camera = null, laser = null, dirty = false;

const touch = () => { dirty = true; };

for (const [name, id] of [['colour', 'colour'], ['most', 'most']]) {
  const value = asked.get(name);
  if (value && [...($(id).options ?? [{ value }])].some((option) => option.value === value)) $(id).value = value;
}
if (asked.get('hidden') === 'no') $('hidden').checked = false;
if (asked.get('back') === 'yes') $('back').checked = true;

// The address has the view and the colours, so that it can be shared.
function keep() {
  const now = new URLSearchParams(room);
  now.set('colour', $('colour').value);
  now.set('most', $('most').value);
  if (!$('hidden').checked) now.set('hidden', 'no');
  if ($('back').checked) now.set('back', 'yes');
  if (orbit) now.set('orbit', orbit.text());
  history.replaceState(null, '', `${location.pathname}?${now}`);
}

function fail(text) {
  $('message').textContent = text;
  $('loaded').textContent = '';
  document.documentElement.dataset.room = 'failed';
}

async function get(what, query) {
  const reply = await fetch(`/bytes/${what}?${query}`);
  if (reply.ok) return reply;
  const page = new DOMParser().parseFromString(await reply.text(), 'text/html');
  throw new Error(page.querySelector('.problem p')?.textContent ?? `the server answers ${reply.status}`);
}

// From the file's axes into the camera's frame. Without a camera, y stays upwards.
function turned(read) {
  const found = read.camera;
  const rows = found ? [found.right, found.down, found.forward] : [[1, 0, 0], [0, -1, 0], [0, 0, -1]];
  const origin = found?.origin ?? [0, 0, 0];
  const turn = (v, from) => rows.map((r) => r.reduce((sum, x, k) => sum + x * (v[k] - from[k]), 0));
  const all = (values, from) => {
    const out = new Float32Array(values.length);
    for (let i = 0; i < values.length; i += 3) out.set(turn(values.subarray(i, i + 3), from), i);
    return out;
  };
  return {
    ...read,
    positions: all(read.positions, origin), normals: all(read.normals, [0, 0, 0]),
    laser: read.laser && turn(read.laser, origin), up: turn([0, 1, 0], [0, 0, 0]),
  };
}

async function truth() {
  if (!source) return null;
  const [scene, depth] = await Promise.all([
    get('view', source).then((r) => r.json()), get('depth', source).then((r) => r.arrayBuffer()),
  ]);
  return { lens: scene.intrinsics, size: scene.size, depth: new Float32Array(depth) };
}

async function load() {
  $('loaded').textContent = 'loading…';
  try {
    const began = performance.now();
    const [bytes, depth] = await Promise.all([get('mesh', room).then((r) => r.arrayBuffer()), truth()]);
    const read = turned(readGlb(bytes));
    if (read.indices.length === 0) throw new Error('This reconstruction has no surface.');
    const i = read.camera?.intrinsics;
    camera = i ? { lens: [i.fx, i.fy, i.cx, i.cy], size: [i.width, i.height] } : null;
    laser = read.laser;
    const points = [];
    for (let k = 0; k < read.positions.length; k += 3) points.push(read.positions.slice(k, k + 3));
    const about = extent(points);
    orbit = new Orbit(Math.max(0.3, about.middle[2]), read.up, about, touch);
    if (asked.has('orbit')) orbit.parse(asked.get('orbit'));
    mesh = new Mesh(context($('view')), read, camera, depth);
    $('loaded').textContent = `${read.indices.length / 3} triangles after ${Math.round(performance.now() - began)} ms`;
    touch();
    document.documentElement.dataset.room = 'shown';
  } catch (error) {
    fail(error.message);
  }
}

const MODES = ['shape', 'error', 'seen'];
function draw() {
  const view = $('view');
  const ratio = Math.min(2, devicePixelRatio || 1);
  const side = Math.min(1600, Math.round($('screen').clientWidth * ratio));
  if (side > 0 && view.width !== side) view.width = view.height = side;
  const mode = MODES.indexOf($('colour').value);
  const most = Number($('most').value);
  mesh.draw(view, orbit, { mode, most, hidden: $('hidden').checked, back: $('back').checked });
  const { context: c, width, height } = fit($('marks'));
  if (camera) drawCamera(c, mesh.matrix, { ...camera, laser }, [width, height]);
  $('limit').textContent = `${most.toFixed(2)} m`;
  $('most').closest('label').hidden = mode !== 1;
  const keys = [
    [],
    [['err0', 'no error'], ['err1', `${most.toFixed(2)} m and more, along the ray`], ['hid', 'hidden from the camera'], ['out', 'outside of its view']],
    [['vis', 'the camera sees it'], ['occ', 'hidden from the camera'], ['off', 'outside of the view']],
  ][mode];
  const text = keys.map(([name, words]) => name + words).join();
  if ($('meaning').dataset.text === text) return;
  $('meaning').dataset.text = text;
  $('meaning').replaceChildren(...keys.map(([name, words]) => {
    const [item, key] = [document.createElement('span'), document.createElement('span')];
    item.className = 'item';
    key.className = `key ${name}`;
    item.append(key, words);
    return item;
  }));
}

function frame() {
  if (dirty && mesh) { dirty = false; draw(); }
  requestAnimationFrame(frame);
}

const png = async () => {
  if (!mesh) return;
  draw();
  try { await savePng([$('view'), $('marks')], 'room.png'); } catch (error) { $('loaded').textContent = `Not saved: ${error.message}.`; }
};

$('controls').addEventListener('submit', (event) => event.preventDefault());
$('controls').addEventListener('input', () => { keep(); touch(); });
$('export').addEventListener('click', png);
$('camera').addEventListener('click', () => { orbit?.camera(); keep(); touch(); });
follow($('screen'), () => (mesh ? orbit : null), () => {}, keep);
$('screen').addEventListener('keydown', (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || !orbit?.key(event)) return;
  event.preventDefault();
  keep();
});
new ResizeObserver(touch).observe($('screen'));
requestAnimationFrame(frame);
load();
