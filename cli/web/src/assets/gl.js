// Programs of WebGL2, and the shader parts that the image and the room in space share.

// Colour maps: polynomials of matplotlib's inferno and viridis (CC0, van der Walt and Smith), the
// same as those of the other pictures.
export const MAPS = `
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
}`;

// The mean h of the bins of the shutter, and its colour over the room.
export const LIGHT = `
precision highp float;
precision highp int;
precision highp usampler3D;
uniform usampler3D full, small;
uniform sampler2D room;
uniform ivec3 size, smallSize;
uniform float shutter, factor, gain, ambient;
uniform bool useFull, hasRoom;
uniform int scale, map;
${MAPS}

float h(ivec3 at) {
  float q;
  if (useFull) q = float(texelFetch(full, at, 0).r);
  else q = float(texelFetch(small, ivec3(at.xy * smallSize.xy / size.xy, at.z), 0).r);
  q /= factor;
  return q * q;
}

float lightAt(ivec2 at, float time) {
  int first = int(floor(time)), count = int(shutter);
  float part = time - float(first), sum = 0.0;
  for (int i = 0; i <= 32; i++) {
    if (i > count) break;
    int bin = first + i;
    if (bin < 0 || bin >= size.z) continue;
    float share = i == 0 ? 1.0 - part : i == count ? part : 1.0;
    if (share > 0.0) sum += share * h(ivec3(at, bin));
  }
  return sum / shutter;
}

vec3 shown(float mean, vec2 uv) {
  float v = mean * gain;
  float t = scale == 0 ? v : scale == 1 ? sqrt(v) : log(max(v, 1e-4) / 1e-4) / log(1e4);
  t = clamp(t, 0.0, 1.0);
  vec3 light = map == 0 ? inferno(t) : map == 1 ? viridis(t) : vec3(t);
  vec3 base = hasRoom ? textureLod(room, uv, 0.0).rgb * ambient : vec3(0.0);
  // Dim light lets the room through.
  vec3 mixed = map == 1 ? mix(light, base + light, hasRoom && ambient > 0.0 ? 0.5 : 0.0) : base * (1.0 - t) + light;
  return clamp(mixed, 0.0, 1.0);
}`;

/** Returns the context of a canvas; throws where there is none. */
export function context(canvas, options) {
  const gl = canvas.getContext('webgl2', { antialias: false, alpha: false, preserveDrawingBuffer: true, ...options });
  if (!gl) throw new Error('This browser has no WebGL2. Enable hardware acceleration, or use another browser.');
  return gl;
}

function shader(gl, type, text) {
  const made = gl.createShader(type);
  gl.shaderSource(made, text);
  gl.compileShader(made);
  if (!gl.getShaderParameter(made, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(made));
  return made;
}

/** A program with the places of its uniforms. */
export class Program {
  constructor(gl, vertex, fragment) {
    this.gl = gl;
    this.program = gl.createProgram();
    gl.attachShader(this.program, shader(gl, gl.VERTEX_SHADER, `#version 300 es\n${vertex}`));
    gl.attachShader(this.program, shader(gl, gl.FRAGMENT_SHADER, `#version 300 es\n${fragment}`));
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program));
    this.places = new Map();
    this.vertices = gl.createVertexArray();
  }

  at(name) {
    if (!this.places.has(name)) this.places.set(name, this.gl.getUniformLocation(this.program, name));
    return this.places.get(name);
  }

  /** Uses the program. Whole numbers and truth values are set by `ints`, others by `floats`. */
  use(ints, floats) {
    const { gl } = this;
    gl.useProgram(this.program);
    gl.bindVertexArray(this.vertices);
    for (const [name, value] of Object.entries(ints)) gl.uniform1i(this.at(name), Number(value));
    for (const [name, value] of Object.entries(floats)) gl.uniform1f(this.at(name), value);
  }
}

/** Makes a texture of 32-bit floats, one for each pixel, at a unit. */
export function floats(gl, unit, width, height, values) {
  if (values.length !== width * height) throw new Error(`expected ${width * height} values, got ${values.length}`);
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, width, height, 0, gl.RED, gl.FLOAT, values);
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
}
