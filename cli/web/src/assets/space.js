// The depth map as points in space, coloured by the light that arrives from them, or that is at the
// surfaces, at the time of the player.
import { LIGHT, Program, floats } from './gl.js';
import { drawCamera, extent, project } from './orbit.js';

const VERTEX = `${LIGHT}
uniform highp sampler2D depth;
uniform vec4 lens;
uniform mat4 see;
uniform float time, middle, bin, dot;
uniform bool surface;
out vec3 colour;

void main() {
  ivec2 at = ivec2(gl_VertexID % size.x, gl_VertexID / size.x);
  float z = texelFetch(depth, at, 0).r;
  vec3 p = vec3((vec2(at) + 0.5 - lens.zw) / lens.xy * z, z);
  gl_Position = z > 0.0 ? see * vec4(p, 1.0) : vec4(0.0, 0.0, 2.0, 1.0);
  // What arrives from a far point left it earlier.
  float when = surface ? time + (length(p) - middle) / bin : time;
  colour = shown(lightAt(at, when), (vec2(at) + 0.5) / vec2(size.xy));
  gl_PointSize = clamp(dot * z / lens.x / max(gl_Position.w, 0.02), 1.0, 32.0);
}`;

const FRAGMENT = `precision highp float;
in vec3 colour;
out vec4 seen;
void main() { seen = vec4(colour, 1.0); }`;

export class Space {
  /** Takes the depth of each pixel, in the order of the image, and the scene's camera. */
  constructor(volume, depth, scene) {
    const { gl, facts } = volume;
    Object.assign(this, { volume, depth, scene, facts, gl });
    this.program = new Program(gl, VERTEX, FRAGMENT);
    floats(gl, 3, facts.width, facts.height, depth);
    const points = [...depth.keys()].filter((i) => depth[i] > 0).map((i) => this.point(i));
    this.extent = extent(points);
    const ranges = points.map((p) => Math.hypot(...p)).sort((a, b) => a - b);
    const at = (share) => ranges[Math.floor(share * (ranges.length - 1))] ?? 1;
    /** The median distance from the camera, and the nearest and the farthest. */
    this.middle = at(0.5);
    this.ends = [at(0), at(1)];
  }

  point(i) {
    const [fx, fy, cx, cy] = this.scene.intrinsics;
    const z = this.depth[i], column = i % this.facts.width, row = Math.floor(i / this.facts.width);
    return [(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z];
  }

  draw(settings, orbit, surface) {
    const { gl, program, volume, facts } = this;
    const { width, height } = volume.canvas;
    this.matrix = orbit.matrix(width / height);
    // Bins that have arrived for the nearest and for the farthest point.
    const [near, far] = surface ? this.ends.map((range) => (range - this.middle) / facts.bin_m) : [0, 0];
    const sharp = volume.isSharp(settings.time + near, settings.shutter + Math.ceil(far - near));
    gl.viewport(0, 0, width, height);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0.03, 0.035, 0.045, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    volume.prepare(program, settings, sharp);
    this.dot = 1.4 * Math.min(width, height) / 2 / Math.tan(orbit.field / 2);
    program.use({ depth: 3, surface }, { time: settings.time, middle: this.middle, bin: facts.bin_m, dot: this.dot });
    gl.uniform4fv(program.at('lens'), this.scene.intrinsics);
    gl.uniformMatrix4fv(program.at('see'), false, this.matrix);
    gl.drawArrays(gl.POINTS, 0, facts.width * facts.height);
    gl.disable(gl.DEPTH_TEST);
  }

  /** Draws camera, laser, spots and the picked pixel over the picture, in its CSS pixels. */
  marks(c, width, height, { spots, picked, light }) {
    if (!this.matrix) return;
    const size = [width, height];
    const { intrinsics, laser } = this.scene;
    const known = laser?.every((x) => x !== null) ? laser : null;
    drawCamera(c, this.matrix, { lens: intrinsics, size: [this.facts.width, this.facts.height], laser: known }, size);
    const from = project(this.matrix, known ?? [0, 0, 0], ...size);
    spots.forEach((spot, i) => {
      const at = spot && project(this.matrix, spot.position, ...size);
      if (!at) return;
      if (from) { c.strokeStyle = '#ff5d5d55'; c.lineWidth = 1; c.beginPath(); c.moveTo(from[0], from[1]); c.lineTo(at[0], at[1]); c.stroke(); }
      for (const [colour, wide] of [['#000a', 3], [light === `spot-${i}` ? '#fff' : '#ffb454', 1.5]]) {
        c.strokeStyle = colour; c.lineWidth = wide; c.beginPath(); c.arc(at[0], at[1], 4, 0, 2 * Math.PI); c.stroke();
      }
      c.font = '10px system-ui, sans-serif'; c.fillStyle = '#fff'; c.fillText(String(i), at[0] + 6, at[1] + 3);
    });
    const i = picked && picked[1] * this.facts.width + picked[0];
    const at = picked && this.depth[i] > 0 && project(this.matrix, this.point(i), ...size);
    if (at) for (const [colour, wide] of [['#000b', 4], ['#4cc9f0', 2]]) {
      c.strokeStyle = colour; c.lineWidth = wide; c.beginPath(); c.arc(at[0], at[1], 7, 0, 2 * Math.PI); c.stroke();
    }
  }

  /** Returns column and row of the nearest point under a place of the picture; null for none. */
  pick(x, y, width, height) {
    let best = null, nearest = Infinity;
    const ratio = this.volume.canvas.width / width;
    for (let i = 0; i < this.depth.length; i++) {
      if (!(this.depth[i] > 0)) continue;
      const at = project(this.matrix, this.point(i), width, height);
      if (!at) continue;
      const away = Math.hypot(at[0] - x, at[1] - y);
      const reach = Math.max(8, 0.6 * this.dot / ratio * this.depth[i] / this.scene.intrinsics[0] / at[2]);
      if (away < reach && at[2] + away / 20 < nearest) { nearest = at[2] + away / 20; best = i; }
    }
    return best === null ? null : [best % this.facts.width, Math.floor(best / this.facts.width)];
  }
}
