// Reads binary glTF 2.0: positions, normals, colours and triangles of all meshes, and the camera
// that picofarm's files describe.
const SIZES = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4 };
const TYPES = { 5121: Uint8Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array };
const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

function chunks(buffer) {
  const view = new DataView(buffer);
  if (buffer.byteLength < 20 || view.getUint32(0, true) !== 0x46546c67 || view.getUint32(4, true) !== 2) {
    throw new Error('this is no binary glTF 2.0');
  }
  const length = view.getUint32(12, true);
  const json = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, length)));
  const start = 20 + length;
  const bytes = start + 8 <= buffer.byteLength ? new Uint8Array(buffer, start + 8, view.getUint32(start, true)) : new Uint8Array();
  return { json, bytes };
}

function accessor({ json, bytes }, index) {
  const a = json.accessors[index], Type = TYPES[a.componentType], size = SIZES[a.type];
  if (!Type || !size || a.sparse || a.bufferView === undefined) throw new Error(`accessor ${index} has a form that is not supported`);
  const view = json.bufferViews[a.bufferView];
  const step = view.byteStride ?? size * Type.BYTES_PER_ELEMENT;
  const start = bytes.byteOffset + (view.byteOffset ?? 0) + (a.byteOffset ?? 0);
  const out = new Type(a.count * size);
  if (step === out.BYTES_PER_ELEMENT * size && start % Type.BYTES_PER_ELEMENT === 0) {
    out.set(new Type(bytes.buffer, start, out.length));
  } else {
    const data = new DataView(bytes.buffer);
    const read = { 5121: 'getUint8', 5123: 'getUint16', 5125: 'getUint32', 5126: 'getFloat32' }[a.componentType];
    for (let i = 0; i < a.count; i++) for (let k = 0; k < size; k++) {
      out[i * size + k] = data[read](start + i * step + k * Type.BYTES_PER_ELEMENT, true);
    }
  }
  return { values: out, size, most: Type === Float32Array ? 1 : 2 ** (8 * Type.BYTES_PER_ELEMENT) - 1 };
}

function multiply(a, b) {
  const out = new Array(16).fill(0);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

/**
 * Returns positions, normals and colours ([x, y, z] and [r, g, b] of each vertex) and triangles in
 * the file's axes, and the camera or null.
 */
export function readGlb(buffer) {
  const file = chunks(buffer);
  const { json } = file;
  const positions = [], normals = [], colours = [], indices = [];
  let vertices = 0;
  const add = (primitive, m) => {
    if ((primitive.mode ?? 4) !== 4) throw new Error('only triangles are supported');
    if (primitive.extensions) throw new Error(`${Object.keys(primitive.extensions).join(', ')} is not supported`);
    const place = accessor(file, primitive.attributes.POSITION).values;
    const normal = primitive.attributes.NORMAL === undefined ? null : accessor(file, primitive.attributes.NORMAL).values;
    const colour = primitive.attributes.COLOR_0 === undefined ? null : accessor(file, primitive.attributes.COLOR_0);
    const count = place.length / 3;
    const turn = (v, i, w) => [0, 1, 2].map((r) => m[r] * v[i] + m[4 + r] * v[i + 1] + m[8 + r] * v[i + 2] + w * m[12 + r]);
    for (let i = 0; i < count; i++) {
      positions.push(...turn(place, 3 * i, 1));
      normals.push(...(normal ? turn(normal, 3 * i, 0) : [0, 0, 0]));
      colours.push(...(colour ? [0, 1, 2].map((k) => colour.values[colour.size * i + k] / colour.most) : [0.6, 0.6, 0.6]));
    }
    const list = primitive.indices === undefined ? Array.from({ length: count }, (_, i) => i) : accessor(file, primitive.indices).values;
    for (const index of list) indices.push(vertices + index);
    vertices += count;
  };
  const walk = (index, above, depth) => {
    const node = json.nodes[index];
    if (depth > 64) throw new Error('nodes are nested too deeply');
    if (node.translation || node.rotation || node.scale) throw new Error('nodes with a translation, rotation or scale are not supported; expected a matrix');
    const m = multiply(above, node.matrix ?? IDENTITY);
    if (node.mesh !== undefined) for (const primitive of json.meshes[node.mesh].primitives) add(primitive, m);
    for (const child of node.children ?? []) walk(child, m, depth + 1);
  };
  const scene = json.scenes?.[json.scene ?? 0];
  for (const node of scene?.nodes ?? []) walk(node, IDENTITY, 0);
  const extras = scene?.extras?.picofarm;
  return {
    positions: Float32Array.from(positions), normals: Float32Array.from(normals),
    colours: Float32Array.from(colours), indices: Uint32Array.from(indices),
    camera: extras?.camera ?? null, laser: extras?.laser?.origin ?? null,
  };
}
