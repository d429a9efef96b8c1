// The volume on the graphics card: 16-bit codes in 3D textures, decoded in the shader. A small level
// shows at once; slabs of the full volume replace it as they arrive.
import { LIGHT, Program, context } from './gl.js';

const VERTEX = `
void main() {
  vec2 p = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
  gl_Position = vec4(2.0 * p - 1.0, 0.0, 1.0);
}`;

const FRAGMENT = `${LIGHT}
uniform vec2 view;
uniform float time;
out vec4 colour;

void main() {
  vec2 uv = gl_FragCoord.xy / view;
  uv.y = 1.0 - uv.y;
  ivec2 at = min(ivec2(uv * vec2(size.xy)), size.xy - 1);
  colour = vec4(shown(lightAt(at, time), uv), 1.0);
}`;

export class Volume {
  /** Prepares the card; throws where it lacks WebGL2 or takes no such volume. */
  constructor(canvas, facts) {
    const gl = context(canvas);
    this.gl = gl;
    this.canvas = canvas;
    this.facts = facts;
    this.program = new Program(gl, VERTEX, FRAGMENT);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const most = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
    const { width, height, bins, small } = facts;
    if (bins > most) throw new Error(`This graphics card takes ${most} bins, and the scene has ${bins}.`);
    this.hasFull = width <= most && height <= most;
    this.full = this.texture3d(0, this.hasFull ? [width, height, bins] : [1, 1, 1]);
    this.small = this.texture3d(1, [small.width, small.height, bins]);
    this.loaded = new Uint8Array(bins);
    this.room = null;
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

  /** Sets what both views need of a program. */
  prepare(program, { shutter, gain, scale, map, ambient }, sharp) {
    const { gl, facts } = this;
    const { small } = facts;
    program.use(
      { full: 0, small: 1, room: 2, useFull: sharp, hasRoom: this.room !== null, scale, map },
      { shutter, gain, ambient, factor: facts.factor },
    );
    gl.uniform3i(program.at('size'), facts.width, facts.height, facts.bins);
    gl.uniform3i(program.at('smallSize'), small.width, small.height, facts.bins);
  }

  /** Draws the light of `shutter` bins from `time` (in bins) on, as an image. */
  draw(settings) {
    const { gl, program } = this;
    const { width, height } = this.canvas;
    gl.viewport(0, 0, width, height);
    this.prepare(program, settings, this.isSharp(settings.time, settings.shutter));
    gl.uniform2f(program.at('view'), width, height);
    gl.uniform1f(program.at('time'), settings.time);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
