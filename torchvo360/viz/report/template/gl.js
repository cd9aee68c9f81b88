// Drawing with WebGL 2: points, and lines as ribbons of a width in pixels.

const POINTS_VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec4 colour;
layout(location = 2) in float frame;
uniform mat4 clip_view;
uniform float until, world_size, least_px, most_px, lift;
out vec4 fill;
void main() {
  gl_Position = clip_view * vec4(position, 1.0);
  if (frame > until) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  gl_PointSize = clamp(world_size / max(gl_Position.w, 1e-6), least_px, most_px);
  fill = vec4(pow(colour.rgb, vec3(lift)), colour.a);
}`;

// shape: 0 a disc, 1 a ring, 2 a square
const POINTS_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 fill;
uniform int shape;
uniform vec4 rim;
out vec4 pixel;
void main() {
  vec2 p = abs(2.0 * gl_PointCoord - 1.0);
  float r = shape == 2 ? max(p.x, p.y) : length(p);
  if (r > 1.0) discard;
  pixel = shape != 0 && r > 0.62 ? rim : fill;
}`;

const LINES_VERTEX = `#version 300 es
layout(location = 0) in vec2 corner;
layout(location = 1) in vec3 from;
layout(location = 2) in vec3 to;
layout(location = 3) in vec4 colour;
layout(location = 4) in float frame;
uniform mat4 clip_view;
uniform vec2 viewport;
uniform float width, near, until;
out vec4 fill;
void main() {
  vec4 a = clip_view * vec4(from, 1.0), b = clip_view * vec4(to, 1.0);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  fill = colour;
  if (frame > until) fill.a *= 0.28;
  if (a.w < near && b.w < near) return;
  if (a.w < near) a = mix(a, b, (near - a.w) / (b.w - a.w));
  if (b.w < near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 way = (b.xy / b.w - a.xy / a.w) * viewport;
  vec2 along = length(way) > 1e-6 ? normalize(way) : vec2(1.0, 0.0);
  vec2 offset = (vec2(-along.y, along.x) * corner.y + along * (2.0 * corner.x - 1.0) * 0.5) * width / viewport;
  vec4 end = corner.x < 0.5 ? a : b;
  gl_Position = vec4(end.xy + offset * end.w, end.zw);
}`;

const LINES_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 fill;
out vec4 pixel;
void main() { pixel = fill; }`;

class Painter {
  // Throws where the browser has no WebGL 2.
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    if (!this.gl) throw new Error("WebGL 2 is missing");
    this.programs = {};
    const gl = this.gl;
    this.corners = this.buffer(new Float32Array([0, -1, 0, 1, 1, -1, 1, 1]));
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  buffer(data) {
    const gl = this.gl, buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    return buffer;
  }

  program(name, vertex, fragment) {
    if (this.programs[name]) return this.programs[name];
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error(`${name}: ${gl.getProgramInfoLog(program)}`);
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const uniform = gl.getActiveUniform(program, i).name;
      uniforms[uniform] = gl.getUniformLocation(program, uniform);
    }
    return (this.programs[name] = { program, uniforms });
  }

  // Makes the drawing as large as it is shown; returns the pixels of the screen to one of the page.
  fit() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    this.gl.viewport(0, 0, width, height);
    return ratio;
  }

  clear() {
    const gl = this.gl;
    gl.clearColor(...rgba(themeColour("stage")));
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  attribute(place, buffer, size, type, normalised, stride, offset, divisor) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, type, normalised, stride, offset);
    gl.vertexAttribDivisor(place, divisor);
  }

  // cloud: {xyz, colour, frame: buffers; count}
  points(cloud, clip_view, { until = Infinity, worldSize = 0, least = 1, most = 64, lift = 1, shape = 0, rim = [0, 0, 0, 1], depth = true }) {
    if (!cloud.count) return;
    const gl = this.gl, { program, uniforms } = this.program("points", POINTS_VERTEX, POINTS_FRAGMENT);
    gl.useProgram(program);
    this.attribute(0, cloud.xyz, 3, gl.FLOAT, false, 0, 0, 0);
    this.attribute(1, cloud.colour, 4, gl.UNSIGNED_BYTE, true, 0, 0, 0);
    this.attribute(2, cloud.frame, 1, gl.FLOAT, false, 0, 0, 0);
    for (const place of [3, 4]) gl.disableVertexAttribArray(place);
    gl.uniformMatrix4fv(uniforms.clip_view, false, clip_view);
    gl.uniform1f(uniforms.until, Number.isFinite(until) ? until : 3e38);
    gl.uniform1f(uniforms.world_size, worldSize);
    gl.uniform1f(uniforms.least_px, least);
    gl.uniform1f(uniforms.most_px, most);
    gl.uniform1f(uniforms.lift, lift);
    gl.uniform1i(uniforms.shape, shape);
    gl.uniform4fv(uniforms.rim, rim);
    gl[depth ? "enable" : "disable"](gl.DEPTH_TEST);
    gl.drawArrays(gl.POINTS, 0, cloud.count);
  }

  // lines: {buffer of from, to, colour and frame (11 floats a segment); count}
  lines(lines, clip_view, { width = 2, near = 1e-4, until = Infinity, depth = true }) {
    if (!lines.count) return;
    const gl = this.gl, { program, uniforms } = this.program("lines", LINES_VERTEX, LINES_FRAGMENT);
    gl.useProgram(program);
    this.attribute(0, this.corners, 2, gl.FLOAT, false, 0, 0, 0);
    for (const [place, size, offset] of [[1, 3, 0], [2, 3, 12], [3, 4, 24], [4, 1, 40]])
      this.attribute(place, lines.buffer, size, gl.FLOAT, false, 44, offset, 1);
    gl.uniformMatrix4fv(uniforms.clip_view, false, clip_view);
    gl.uniform2f(uniforms.viewport, this.canvas.width, this.canvas.height);
    gl.uniform1f(uniforms.width, width);
    gl.uniform1f(uniforms.near, near);
    gl.uniform1f(uniforms.until, Number.isFinite(until) ? until : 3e38);
    gl[depth ? "enable" : "disable"](gl.DEPTH_TEST);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, lines.count);
  }

  // segments: [from, to, colour, frame] each
  segments(list) {
    const data = new Float32Array(11 * list.length);
    list.forEach(([from, to, colour, frame], i) => data.set([...from, ...to, ...colour, frame], 11 * i));
    return { buffer: this.buffer(data), count: list.length };
  }

  cloud(xyz, colour, frame) {
    return { xyz: this.buffer(xyz), colour: this.buffer(colour), frame: this.buffer(frame), count: xyz.length / 3 };
  }

  release(...things) {
    for (const thing of things)
      for (const value of Object.values(thing || {})) if (value instanceof WebGLBuffer) this.gl.deleteBuffer(value);
  }
}

// Turns pointer, wheel and keys on a canvas into moves. `moves` has any of turn(dx, dy), pan(dx, dy), zoom(factor, x, y) and click(x, y).
function listen(canvas, moves) {
  const pointers = new Map();
  let began = null, gap = 0;
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const distance = () => {
    const [p, q] = [...pointers.values()];
    return Math.hypot(p[0] - q[0], p[1] - q[1]);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, place(event));
    began = pointers.size === 1 ? { at: place(event), still: true, pan: event.shiftKey || event.button > 0 } : null;
    gap = pointers.size === 2 ? distance() : 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = place(event), dx = now[0] - before[0], dy = now[1] - before[1];
    pointers.set(event.pointerId, now);
    if (pointers.size === 2) {
      const [p, q] = [...pointers.values()], wide = distance();
      if (gap) moves.zoom(gap / Math.max(wide, 1), (p[0] + q[0]) / 2, (p[1] + q[1]) / 2);
      gap = wide;
      moves.pan?.(dx / 2, dy / 2);
    } else if (began) {
      if (began.still && Math.hypot(now[0] - began.at[0], now[1] - began.at[1]) < 4) return;
      began.still = false;
      if (began.pan || !moves.turn) moves.pan?.(dx, dy);
      else moves.turn(dx, dy);
    }
  });
  const end = (event) => {
    pointers.delete(event.pointerId);
    gap = 0;
    if (event.type === "pointerup" && began?.still) moves.click?.(...place(event), event.pointerType === "touch");
    began = null;
  };
  canvas.addEventListener("pointerup", end);
  canvas.addEventListener("pointercancel", end);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : 1;
    moves.zoom(Math.exp(clamp(event.deltaY * lines, -240, 240) * 0.0015), ...place(event));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const middle = [canvas.clientWidth / 2, canvas.clientHeight / 2];
    const arrows = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (event.key === "+" || event.key === "=") moves.zoom(1 / 1.2, ...middle);
    else if (event.key === "-") moves.zoom(1.2, ...middle);
    else if (event.shiftKey && arrows[event.key]) (moves.turn || moves.pan)(...arrows[event.key].map((step) => 30 * step));
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
}
