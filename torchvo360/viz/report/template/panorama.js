// The picture of the picked frame: looked at from inside for a panorama, as it is for a pinhole.

const PANORAMA_VERTEX = `#version 300 es
layout(location = 0) in vec2 corner;
out vec2 screen;
void main() {
  screen = vec2(2.0 * corner.x - 1.0, corner.y);
  gl_Position = vec4(screen, 0.0, 1.0);
}`;

// Each pixel's ray becomes longitude and latitude: lon = atan(x, z), lat = asin(-y); u = fx lon + cx, v = fy lat + cy, as
// shares of the image's size. A panorama of less than the sphere leaves the ground as it is.
const PANORAMA_FRAGMENT = `#version 300 es
precision highp float;
in vec2 screen;
uniform sampler2D image;
uniform mat3 cam_look;
uniform vec2 reach;
uniform vec4 intrinsics;
out vec4 pixel;
const float TAU = 6.28318530717959;
void main() {
  vec3 ray = normalize(cam_look * vec3(screen * reach, 1.0));
  vec2 angles = vec2(atan(ray.x, ray.z), asin(clamp(-ray.y, -1.0, 1.0)));
  vec2 place = angles * intrinsics.xy + intrinsics.zw;
  place.x = mod(place.x, TAU * intrinsics.x);
  if (max(place.x, place.y) > 1.0001 || place.y < -0.0001) discard;
  pixel = vec4(texture(image, place).rgb, 1.0);
}`;

class Pictures {
  constructor(list) {
    this.rows = [];
    this.list = [];
    for (const picture of list)
      if (rowOfIndex.has(picture.index)) {
        this.rows.push(rowOfIndex.get(picture.index));
        this.list.push(picture);
      }
    this.images = new Map();
  }

  // The number of the picture nearest to a row, -1 where there is none.
  nearest(row) {
    let best = -1;
    this.rows.forEach((at, k) => { if (best < 0 || Math.abs(at - row) < Math.abs(this.rows[best] - row)) best = k; });
    return best;
  }

  blob(k) {
    return new Blob([bytesOf(this.list[k].jpeg)], { type: "image/jpeg" });
  }

  async image(k) {
    if (!this.images.has(k)) {
      if (this.images.size > 24) this.images.delete(this.images.keys().next().value);
      this.images.set(k, createImageBitmap(this.blob(k)));
    }
    return this.images.get(k);
  }
}

class Panorama {
  constructor(canvas, pictures, onLook) {
    this.canvas = canvas;
    this.pictures = pictures;
    this.onLook = onLook;
    this.painter = new Painter(canvas);
    this.steady = true;
    this.overlay = false;
    this.row = this.wanted = this.loaded = -1;
    const gl = this.painter.gl;
    this.texture = gl.createTexture();
    this.cloud = this.painter.cloud(cloudShown.xyz, cloudShown.colour, cloudShown.frame);
    const moved = (move) => (...values) => { move.apply(this, values); this.redraw(); };
    listen(canvas, { turn: moved(this.turn), zoom: moved(this.zoom) });
    new ResizeObserver(() => this.redraw()).observe(canvas);
    this.reset();
  }

  reset() {
    this.pitch = 0;
    this.fov = 1.5;
    this.yaw = this.steady && this.row >= 0 ? Math.atan2(R_view_cam(this.row)[2], R_view_cam(this.row)[5]) : 0;
    this.redraw();
  }

  // Yaw and pitch are against the world while the view is steady, else against the camera.
  get R_base() {
    if (this.steady) return [1, 0, 0, 0, 1, 0, 0, 0, 1];
    const R = this.loaded >= 0 ? R_view_cam(this.pictures.rows[this.loaded]) : R_view_cam(Math.max(this.row, 0));
    return [R[0], R[2], -R[1], R[3], R[5], -R[4], R[6], R[8], -R[7]]; // right, ahead, up of the camera
  }

  // Right, up and ahead of the look in the axes that are shown.
  get look() {
    const cp = Math.cos(this.pitch), sp = Math.sin(this.pitch), cy = Math.cos(this.yaw), sy = Math.sin(this.yaw);
    const base = this.R_base;
    const ahead = turned(base, [sy * cp, cy * cp, sp]), right = turned(base, [cy, -sy, 0]);
    return { right, up: cross(right, ahead), ahead };
  }

  setSteady(steady) {
    const { ahead } = this.look;
    this.steady = steady;
    const [x, y, z] = turnedBack(this.R_base, ahead);
    this.yaw = Math.atan2(x, y);
    this.pitch = Math.asin(clamp(z, -1, 1));
    this.redraw();
  }

  turn(dx, dy) {
    const step = (2 * Math.tan(this.fov / 2)) / this.canvas.clientHeight;
    this.yaw -= dx * step;
    this.pitch = clamp(this.pitch + dy * step, -Math.PI / 2, Math.PI / 2);
  }

  zoom(factor) {
    this.fov = clamp(this.fov * factor, 0.35, 2.3);
  }

  async show(row) {
    this.row = row;
    const k = (this.wanted = this.pictures.nearest(row));
    if (k >= 0 && k !== this.loaded) {
      const image = await this.pictures.image(k);
      if (this.wanted !== k) return; // another one has been picked meanwhile
      const gl = this.painter.gl;
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
      for (const [name, value] of [["MIN_FILTER", "LINEAR"], ["MAG_FILTER", "LINEAR"], ["WRAP_S", "REPEAT"], ["WRAP_T", "CLAMP_TO_EDGE"]])
        gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], gl[value]);
      this.loaded = k;
      this.canvas.dataset.frame = this.pictures.list[k].index;
    }
    this.redraw();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.draw(); });
  }

  draw() {
    const { painter, canvas } = this;
    if (!canvas.clientWidth || this.row < 0) return;
    const ratio = painter.fit(), gl = painter.gl;
    painter.clear();
    const look = this.look;
    this.onLook(look.ahead, this);
    if (this.loaded < 0) return;
    const row = this.pictures.rows[this.loaded], R = R_view_cam(row);
    const reachY = Math.tan(this.fov / 2), reach = [reachY * (canvas.clientWidth / canvas.clientHeight), reachY];
    const { program, uniforms } = painter.program("panorama", PANORAMA_VERTEX, PANORAMA_FRAGMENT);
    gl.useProgram(program);
    painter.attribute(0, painter.corners, 2, gl.FLOAT, false, 0, 0, 0);
    for (const place of [1, 2, 3, 4]) gl.disableVertexAttribArray(place);
    gl.disable(gl.DEPTH_TEST);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.uniformMatrix3fv(uniforms.cam_look, false, [look.right, look.up, look.ahead].flatMap((axis) => turnedBack(R, axis)));
    gl.uniform2fv(uniforms.reach, reach);
    const [fx, fy, cx, cy] = content.camera.intrinsics, { width, height } = content.camera;
    gl.uniform4f(uniforms.intrinsics, fx / width, fy / height, cx / width, cy / height);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    if (this.overlay) this.drawOverlay(look, pathAt(row), reach, ratio);
  }

  // The map's points where they belong in the picture.
  drawOverlay({ right, up, ahead }, eye, reach, ratio) {
    const back = scaled(ahead, -1), near = 1e-3 * box.radius, far = 200 * box.radius;
    const view = new Float32Array([
      right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
      -dot(right, eye), -dot(up, eye), -dot(back, eye), 1,
    ]);
    const clip = new Float32Array([
      1 / reach[0], 0, 0, 0, 0, 1 / reach[1], 0, 0,
      0, 0, -(far + near) / (far - near), -1, 0, 0, (-2 * far * near) / (far - near), 0,
    ]);
    const size = 4.5 * ratio, rim = rgba(themeColour("weak"));
    this.painter.points(this.cloud, product(clip, view), { least: size, most: size, shape: 1, rim, depth: false });
  }
}

class PlainPicture {
  constructor(image, pictures) {
    this.image = image;
    this.pictures = pictures;
    this.shown = -1;
  }

  show(row) {
    const k = this.pictures.nearest(row);
    if (k < 0 || k === this.shown) return;
    if (this.url) URL.revokeObjectURL(this.url);
    this.url = URL.createObjectURL(this.pictures.blob(k));
    this.image.src = this.url;
    this.shown = k;
  }
}
