// The volume on the graphics card: 16-bit codes in 3D textures, decoded in the shader. A small level
// shows at once; slabs of the full volume replace it as they arrive.
const VERTEX = `#version 300 es
void main() {
  vec2 p = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
  gl_Position = vec4(2.0 * p - 1.0, 0.0, 1.0);
}`;

// Colour maps: polynomials of matplotlib's inferno and viridis (CC0, van der Walt and Smith), the
// same as those of the other pictures.
const FRAGMENT = `#version 300 es
precision highp float;
precision highp usampler3D;
uniform usampler3D full, small;
uniform sampler2D room;
uniform ivec3 size, smallSize;
uniform vec2 view;
uniform float time, shutter, factor, gain, ambient;
uniform bool useFull, hasRoom;
uniform int scale, map;
out vec4 colour;

float h(ivec3 at) {
  float q;
  if (useFull) q = float(texelFetch(full, at, 0).r);
  else q = float(texelFetch(small, ivec3(at.xy * smallSize.xy / size.xy, at.z), 0).r);
  q /= factor;
  return q * q;
}

vec3 inferno(float t) {
  const vec3 c0 = vec3(0.00021894, 0.001651, -0.0194809), c1 = vec3(0.10651342, 0.5639564, 3.9327124),
    c2 = vec3(11.602493, -3.972854, -15.942394), c3 = vec3(-41.703996, 17.4364, 44.354145),
    c4 = vec3(77.16294, -33.402362, -81.807313), c5 = vec3(-71.319428, 32.626064, 73.209520),
    c6 = vec3(25.131126, -12.242669, -23.070325);
  return c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * (c5 + t * c6)))));
}

vec3 viridis(float t) {
  const vec3 c0 = vec3(0.27772733, 0.00540734, 0.33409981), c1 = vec3(0.10509304, 1.4046135, 1.3845902),
    c2 = vec3(-0.33086183, 0.21484756, 0.095095164), c3 = vec3(-4.6342305, -5.7991010, -19.332441),
    c4 = vec3(6.2282699, 14.179934, 56.690552), c5 = vec3(4.7763850, -13.745145, -65.353033),
    c6 = vec3(-5.4354559, 4.6458526, 26.312435);
  return c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * (c5 + t * c6)))));
}

void main() {
  vec2 uv = gl_FragCoord.xy / view;
  uv.y = 1.0 - uv.y;
  ivec2 at = min(ivec2(uv * vec2(size.xy)), size.xy - 1);
  int first = int(floor(time)), count = int(shutter);
  float part = time - float(first), sum = 0.0;
  for (int i = 0; i <= 32; i++) {
    if (i > count) break;
    int bin = first + i;
    if (bin < 0 || bin >= size.z) continue;
    float share = i == 0 ? 1.0 - part : i == count ? part : 1.0;
    if (share > 0.0) sum += share * h(ivec3(at, bin));
  }
  float v = sum / shutter * gain;
  float t = scale == 0 ? v : scale == 1 ? sqrt(v) : log(max(v, 1e-4) / 1e-4) / log(1e4);
  t = clamp(t, 0.0, 1.0);
  vec3 light = map == 0 ? inferno(t) : map == 1 ? viridis(t) : vec3(t);
  vec3 base = hasRoom ? texture(room, uv).rgb * ambient : vec3(0.0);
  // Dim light lets the room through.
  vec3 mixed = map == 1 ? mix(light, base + light, hasRoom && ambient > 0.0 ? 0.5 : 0.0) : base * (1.0 - t) + light;
  colour = vec4(clamp(mixed, 0.0, 1.0), 1.0);
}`;

function shader(gl, type, text) {
  const made = gl.createShader(type);
  gl.shaderSource(made, text);
  gl.compileShader(made);
  if (!gl.getShaderParameter(made, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(made));
  return made;
}

export class Volume {
  /** Prepares the card; throws where it lacks WebGL2 or takes no such volume. */
  constructor(canvas, facts) {
    const gl = canvas.getContext('webgl2', { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error('This browser has no WebGL2. Enable hardware acceleration, or use another browser.');
    this.gl = gl;
    this.canvas = canvas;
    this.facts = facts;
    this.program = gl.createProgram();
    gl.attachShader(this.program, shader(gl, gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(this.program, shader(gl, gl.FRAGMENT_SHADER, FRAGMENT));
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program));
    gl.useProgram(this.program);
    this.places = new Map();
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.bindVertexArray(gl.createVertexArray());
    const most = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
    const { width, height, bins, small } = facts;
    if (bins > most) throw new Error(`This graphics card takes ${most} bins, and the scene has ${bins}.`);
    this.hasFull = width <= most && height <= most;
    this.full = this.texture3d(0, this.hasFull ? [width, height, bins] : [1, 1, 1]);
    this.small = this.texture3d(1, [small.width, small.height, bins]);
    this.loaded = new Uint8Array(bins);
    this.room = null;
    ['full', 'small', 'room'].forEach((name, unit) => gl.uniform1i(this.at(name), unit));
    gl.uniform3i(this.at('size'), width, height, bins);
    gl.uniform3i(this.at('smallSize'), small.width, small.height, bins);
    gl.uniform1f(this.at('factor'), facts.factor);
  }

  at(name) {
    if (!this.places.has(name)) this.places.set(name, this.gl.getUniformLocation(this.program, name));
    return this.places.get(name);
  }

  texture3d(unit, [w, h, d]) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_3D, texture);
    gl.texStorage3D(gl.TEXTURE_3D, 1, gl.R16UI, w, h, d);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) gl.texParameteri(gl.TEXTURE_3D, side, gl.CLAMP_TO_EDGE);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_3D, filter, gl.NEAREST);
    return texture;
  }

  upload(unit, w, h, from, count, bytes) {
    const { gl } = this;
    const codes = new Uint16Array(bytes);
    if (codes.length !== w * h * count) throw new Error(`expected ${w * h * count} codes, got ${codes.length}`);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.texSubImage3D(gl.TEXTURE_3D, 0, 0, 0, from, w, h, count, gl.RED_INTEGER, gl.UNSIGNED_SHORT, codes);
  }

  setSmall(bytes) {
    const { small, bins } = this.facts;
    this.upload(1, small.width, small.height, 0, bins, bytes);
  }

  setSlab(from, count, bytes) {
    this.upload(0, this.facts.width, this.facts.height, from, count, bytes);
    this.loaded.fill(1, from, from + count);
  }

  setRoom(image) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.LINEAR);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    this.room = image;
  }

  /** Whether the bins of a frame have arrived in full. */
  isSharp(time, shutter) {
    const first = Math.max(0, Math.floor(time)), last = Math.min(this.facts.bins - 1, Math.floor(time) + shutter);
    for (let bin = first; bin <= last; bin++) if (!this.loaded[bin]) return false;
    return this.hasFull;
  }

  /** Draws the light of `shutter` bins from `time` (in bins) on. */
  draw({ time, shutter, gain, scale, map, ambient }) {
    const { gl } = this;
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.uniform2f(this.at('view'), this.canvas.width, this.canvas.height);
    gl.uniform1f(this.at('time'), time);
    gl.uniform1f(this.at('shutter'), shutter);
    gl.uniform1f(this.at('gain'), gain);
    gl.uniform1f(this.at('ambient'), ambient);
    gl.uniform1i(this.at('useFull'), this.isSharp(time, shutter) ? 1 : 0);
    gl.uniform1i(this.at('hasRoom'), this.room ? 1 : 0);
    gl.uniform1i(this.at('scale'), scale);
    gl.uniform1i(this.at('map'), map);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
