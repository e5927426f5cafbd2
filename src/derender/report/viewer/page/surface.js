"use strict";
// The surface of a GLB in WebGL 2, lit in the object's own frame: x right, y up, z towards the viewer.

const VERTEX = `#version 300 es
in vec3 position; in vec3 normal; in vec2 uv;
uniform mat4 place; uniform float focal; uniform float aspect;
out vec3 outward; out vec2 at;
void main() {
  vec4 seen = place * vec4(position, 1.0);
  float near = 0.2, far = 4.0;
  gl_Position = vec4(seen.x * focal / aspect, seen.y * focal, (seen.z * (far + near) + 2.0 * far * near) / (near - far), -seen.z);
  outward = normal; at = uv;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 outward; in vec2 at;
uniform sampler2D albedo; uniform vec3 toLight; uniform vec2 strength; uniform int paint;
out vec4 colour;
void main() {
  vec3 n = normalize(outward);
  float shade = strength.x + strength.y * max(0.0, dot(n, toLight));
  vec3 skin = texture(albedo, at).rgb;
  if (paint == 1) colour = vec4(skin, 1.0);
  else if (paint == 2) colour = vec4(vec3(0.9 * shade / max(1.0, strength.x + strength.y)), 1.0);
  else if (paint == 3) colour = vec4(0.5 + 0.5 * n, 1.0);
  else colour = vec4(skin * shade, 1.0);
  if (!gl_FrontFacing) colour = vec4(vec3(0.28), 1.0);
}`;
const PAINTS = ["lit", "albedo", "clay", "normals"];

function readGlb(buffer) {
  const head = new DataView(buffer);
  if (head.getUint32(0, true) !== 0x46546c67) throw new Error("no GLB");
  const jsonLength = head.getUint32(12, true);
  const gltf = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, jsonLength)));
  const start = 20 + jsonLength + 8;
  const kinds = { 5126: Float32Array, 5125: Uint32Array, 5123: Uint16Array, 5121: Uint8Array };
  const widths = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4 };
  const view = (index) => {
    const found = gltf.bufferViews[index];
    return buffer.slice(start + (found.byteOffset || 0), start + (found.byteOffset || 0) + found.byteLength);
  };
  const values = (index) => {
    const found = gltf.accessors[index];
    return new kinds[found.componentType](view(found.bufferView), found.byteOffset || 0, found.count * widths[found.type]);
  };
  const primitive = gltf.meshes[0].primitives[0];
  const image = gltf.images[0];
  return {
    position: values(primitive.attributes.POSITION),
    normal: values(primitive.attributes.NORMAL),
    uv: values(primitive.attributes.TEXCOORD_0),
    index: Uint32Array.from(values(primitive.indices)),
    texture: new Blob([view(image.bufferView)], { type: image.mimeType }),
  };
}

class Surface {
  // `redraw` is called instead of drawing where there is no WebGL: the server then shows the turned object.
  constructor(canvas, redraw) {
    this.canvas = canvas;
    this.redraw = redraw;
    this.fovDeg = 10;
    this.light = { ambient: 0.4, diffuse: 0.6, pitch_deg: 0, yaw_deg: 0 };
    this.paint = "lit";
    this.count = 0;
    this.front();
    this.gl = canvas.getContext("webgl2", { antialias: true, premultipliedAlpha: false, preserveDrawingBuffer: true });
    canvas.dataset.drawn = this.gl ? "webgl" : "server";
    if (this.gl) this.prepare();
    this.listen();
  }

  prepare() {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    this.program = program;
    this.buffers = { position: gl.createBuffer(), normal: gl.createBuffer(), uv: gl.createBuffer(), index: gl.createBuffer() };
    this.texture = gl.createTexture();
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    this.canvas.addEventListener("webglcontextrestored", () => { this.prepare(); if (this.glb) this.show(this.glb); });
  }

  async show(glb) {
    this.glb = glb;
    if (!this.gl) return this.draw();
    const gl = this.gl;
    const mesh = readGlb(glb);
    const picture = await createImageBitmap(mesh.texture);
    for (const name of ["position", "normal", "uv"]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[name]);
      gl.bufferData(gl.ARRAY_BUFFER, mesh[name], gl.STATIC_DRAW);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers.index);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.index, gl.STATIC_DRAW);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    for (const way of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, way, gl.LINEAR);
    this.count = mesh.index.length;
    this.draw();
  }

  front() { this.yaw = 0; this.pitch = 0; this.zoom = 1; }

  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; if (this.gl) this.paintNow(); else this.redraw(this); });
  }

  paintNow() {
    const gl = this.gl;
    const side = Math.max(64, Math.round(this.canvas.clientWidth * Math.min(2, devicePixelRatio || 1)));
    if (this.canvas.width !== side) { this.canvas.width = side; this.canvas.height = side; }
    gl.viewport(0, 0, side, side);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (!this.count) return;
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(this.program);
    for (const [name, width] of [["position", 3], ["normal", 3], ["uv", 2]]) {
      const place = gl.getAttribLocation(this.program, name);
      if (place < 0) continue;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[name]);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, width, gl.FLOAT, false, 0, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers.index);
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    const uniform = (name) => gl.getUniformLocation(this.program, name);
    // columns of: turn about y, then about x, then one unit away from the eye
    gl.uniformMatrix4fv(uniform("place"), false, [cy, sp * sy, -cp * sy, 0, 0, cp, sp, 0, sy, -sp * cy, cp * cy, 0, 0, 0, -1, 1]);
    gl.uniform1f(uniform("focal"), this.zoom / Math.tan((this.fovDeg * Math.PI) / 360));
    gl.uniform1f(uniform("aspect"), 1);
    const [pitch, yaw] = [this.light.pitch_deg, this.light.yaw_deg].map((angle) => (angle * Math.PI) / 180);
    const ray = [-Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch) * Math.cos(yaw), Math.cos(yaw) * Math.cos(pitch)];
    const length = Math.hypot(...ray);
    gl.uniform3f(uniform("toLight"), ...ray.map((value) => value / length));
    gl.uniform2f(uniform("strength"), this.light.ambient, this.light.diffuse);
    gl.uniform1i(uniform("paint"), PAINTS.indexOf(this.paint));
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_INT, 0);
  }

  turn(yaw, pitch, zoom = 1) {
    this.yaw += yaw;
    this.pitch = Math.max(-1.5, Math.min(1.5, this.pitch + pitch));
    this.zoom = Math.max(0.4, Math.min(6, this.zoom * zoom));
    this.draw();
  }

  listen() {
    const canvas = this.canvas;
    const fingers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const now = [event.clientX, event.clientY];
      if (fingers.size === 1) this.turn((now[0] - before[0]) * 0.01, (now[1] - before[1]) * 0.01);
      else {
        const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
        const apart = (a) => Math.max(1, Math.hypot(a[0] - other[0], a[1] - other[1]));
        this.turn(0, 0, apart(now) / apart(before));
      }
      fingers.set(event.pointerId, now);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.turn(0, 0, Math.exp(-event.deltaY * 0.001)); }, { passive: false });
    const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1], "+": [0, 0, 1.1], "=": [0, 0, 1.1], "-": [0, 0, 1 / 1.1] };
    canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "0") { this.front(); this.draw(); } else if (keys[event.key]) this.turn(...keys[event.key]); else return;
      event.preventDefault();
    });
    new ResizeObserver(() => this.draw()).observe(canvas);
  }
}
