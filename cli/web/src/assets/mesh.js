// Draws a mesh in the camera's frame: its shape, its distance from the true depth, and what the
// camera sees of it. What is behind the mesh's own surface, as seen from the camera, is hidden.
import { MAPS, Program, floats } from './gl.js';

const NEAR = 0.02, FAR = 200, SIDE = 1024;

const BEFORE = `
in vec3 place;
uniform mat4 from;
void main() { gl_Position = from * vec4(place, 1.0); }`;

const VERTEX = `
in vec3 place, normal, tint;
uniform mat4 see;
out vec3 p, n, own;
void main() { p = place; n = normal; own = tint; gl_Position = see * vec4(place, 1.0); }`;

const FRAGMENT = `precision highp float;
${MAPS}
in vec3 p, n, own;
uniform highp sampler2D nearest, depth;
uniform vec4 lens, trueLens;
uniform vec2 size, trueSize;
uniform vec3 eye;
uniform float most;
uniform int mode;
uniform bool hasTruth, hidden, back;
out vec4 colour;

// The true depth at a place of the image: between pixels of one surface the inverse is linear.
float trueDepth(vec2 at) {
  ivec2 last = ivec2(trueSize) - 1, from = ivec2(floor(at - 0.5));
  vec2 part = at - 0.5 - vec2(from);
  vec4 z;
  for (int i = 0; i < 4; i++) z[i] = texelFetch(depth, clamp(from + ivec2(i & 1, i >> 1), ivec2(0), last), 0).r;
  float low = min(min(z.x, z.y), min(z.z, z.w)), high = max(max(z.x, z.y), max(z.z, z.w));
  if (low <= 0.0 || high > 1.1 * low) return texelFetch(depth, ivec2(at), 0).r;
  return 1.0 / mix(mix(1.0 / z.x, 1.0 / z.y, part.x), mix(1.0 / z.z, 1.0 / z.w, part.x), part.y);
}

void main() {
  vec3 towards = normalize(eye - p);
  vec3 normal = dot(n, n) > 0.0 ? normalize(n) : normalize(cross(dFdx(p), dFdy(p)));
  if (dot(n, n) > 0.0 && dot(normal, towards) < 0.0 && !back) discard;
  float shade = 0.35 + 0.65 * abs(dot(normal, towards));
  // 0: the camera sees it; 1: hidden behind the surface; 2: outside of the view.
  int kind = 2;
  vec2 film = lens.xy * p.xy / max(p.z, 1e-6) + lens.zw;
  if (p.z > 0.0 && all(greaterThanEqual(film, vec2(0.0))) && all(lessThan(film, size))) {
    float d = texture(nearest, film / size).r;
    float front = 2.0 * ${FAR.toFixed(1)} * ${NEAR.toFixed(2)} / (${(FAR + NEAR).toFixed(2)} - (2.0 * d - 1.0) * ${(FAR - NEAR).toFixed(2)});
    kind = p.z > front + 0.03 + 0.02 * front ? 1 : 0;
  }
  if (kind != 0 && !hidden) discard;
  vec3 base = own;
  if (mode == 1) {
    base = kind == 1 ? vec3(0.30, 0.34, 0.42) : vec3(0.22, 0.22, 0.24);
    vec2 at = trueLens.xy * p.xy / max(p.z, 1e-6) + trueLens.zw;
    if (kind == 0 && hasTruth && all(greaterThanEqual(at, vec2(0.0))) && all(lessThan(at, trueSize))) {
      float z = trueDepth(at);
      if (z > 0.0) base = viridis(clamp(abs(p.z - z) * length(p) / p.z / most, 0.0, 1.0));
    }
  } else if (mode == 2) {
    base = kind == 0 ? vec3(0.80, 0.78, 0.72) : kind == 1 ? vec3(0.95, 0.55, 0.20) : vec3(0.36, 0.45, 0.62);
  }
  colour = vec4(base * shade, 1.0);
}`;

/** The matrix of a pinhole camera with the lens fx, fy, cx, cy, for its own frame, by columns. */
function pinhole([fx, fy, cx, cy], [w, h]) {
  const m = new Float32Array(16);
  m[0] = 2 * fx / w; m[8] = 2 * cx / w - 1;
  // Rows of the texture count downwards, as those of the image.
  m[5] = 2 * fy / h; m[9] = 2 * cy / h - 1;
  m[10] = (FAR + NEAR) / (FAR - NEAR); m[14] = -2 * FAR * NEAR / (FAR - NEAR);
  m[11] = 1;
  return m;
}

export class Mesh {
  /**
   * Takes a mesh in the camera's frame, with the camera's lens and size of its image. `truth` is the
   * depth of a scene with its lens and size, or null.
   */
  constructor(gl, mesh, camera, truth) {
    Object.assign(this, { gl, camera, truth, count: mesh.indices.length });
    this.program = new Program(gl, VERTEX, FRAGMENT);
    this.before = new Program(gl, BEFORE, 'precision highp float;\nvoid main() {}');
    const buffer = (target, values) => {
      const made = gl.createBuffer();
      gl.bindBuffer(target, made);
      gl.bufferData(target, values, gl.STATIC_DRAW);
      return made;
    };
    const all = { place: mesh.positions, normal: mesh.normals, tint: mesh.colours };
    const buffers = Object.fromEntries(Object.entries(all).map(([name, v]) => [name, buffer(gl.ARRAY_BUFFER, v)]));
    for (const program of [this.program, this.before]) {
      gl.bindVertexArray(program.vertices);
      for (const [name, made] of Object.entries(buffers)) {
        const at = gl.getAttribLocation(program.program, name);
        if (at < 0) continue;
        gl.bindBuffer(gl.ARRAY_BUFFER, made);
        gl.enableVertexAttribArray(at);
        gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
      }
      buffer(gl.ELEMENT_ARRAY_BUFFER, mesh.indices);
    }
    if (truth) floats(gl, 1, ...truth.size, truth.depth);
    if (camera) this.look();
  }

  /** Draws the depth of the mesh as the camera sees it, into a texture. */
  look() {
    const { gl, camera } = this;
    gl.activeTexture(gl.TEXTURE0);
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT32F, SIDE, SIDE);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, texture, 0);
    gl.drawBuffers([gl.NONE]);
    gl.viewport(0, 0, SIDE, SIDE);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    this.before.use({}, {});
    gl.uniformMatrix4fv(this.before.at('from'), false, pinhole(camera.lens, camera.size));
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_INT, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  draw(canvas, orbit, { mode, most, hidden, back }) {
    const { gl, program, camera, truth } = this;
    this.matrix = orbit.matrix(canvas.width / canvas.height);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0.03, 0.035, 0.045, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    program.use({ nearest: 0, depth: 1, mode, hasTruth: truth !== null, hidden: hidden || !camera, back }, { most });
    gl.uniform4fv(program.at('lens'), camera?.lens ?? [1, 1, 0, 0]);
    gl.uniform2fv(program.at('size'), camera?.size ?? [0, 0]);
    gl.uniform4fv(program.at('trueLens'), truth?.lens ?? [1, 1, 0, 0]);
    gl.uniform2fv(program.at('trueSize'), truth?.size ?? [0, 0]);
    gl.uniform3fv(program.at('eye'), orbit.eye());
    gl.uniformMatrix4fv(program.at('see'), false, this.matrix);
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_INT, 0);
  }
}
