// The two ways to look at the world: turning about a place, and from above.

class Orbit {
  constructor() {
    this.reset();
  }

  reset() {
    this.target = [...box.middle];
    this.azimuth = -0.6;
    this.elevation = 0.62;
    this.distance = null; // until the shape of the canvas is known
  }

  get near() {
    return (this.distance || box.radius) * 0.01;
  }

  axes() {
    const ce = Math.cos(this.elevation), se = Math.sin(this.elevation), ca = Math.cos(this.azimuth), sa = Math.sin(this.azimuth);
    const back = [sa * ce, -ca * ce, se];
    const right = [ca, sa, 0];
    return { right, back, up: cross(back, right) };
  }

  clipView(width, height) {
    const aspect = width / height, half = Math.tan(Orbit.FOV / 2);
    this.pixel = (2 * half) / height;
    const { right, up, back } = this.axes();
    if (this.distance === null) this.distance = Math.max((0.8 * box.radius) / half / Math.min(1, 0.75 * aspect), this.distanceToSee(path, half, aspect));
    const eye = add(this.target, scaled(back, this.distance));
    const near = this.near, far = this.distance * 50 + 20 * box.radius;
    const view = new Float32Array([
      right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
      -dot(right, eye), -dot(up, eye), -dot(back, eye), 1,
    ]);
    const clip = new Float32Array([
      1 / (half * aspect), 0, 0, 0, 0, 1 / half, 0, 0,
      0, 0, -(far + near) / (far - near), -1, 0, 0, (-2 * far * near) / (far - near), 0,
    ]);
    return product(clip, view);
  }

  // The least distance from which all of some points are within nine tenths of the view.
  distanceToSee(xyz, half, aspect) {
    const { right, up, back } = this.axes();
    let distance = 0;
    for (let i = 0; i < xyz.length; i += 3) {
      const p = subtract(xyz.subarray(i, i + 3), this.target);
      const aside = Math.max(Math.abs(dot(right, p)) / aspect, Math.abs(dot(up, p))) / (0.9 * half);
      distance = Math.max(distance, aside + dot(back, p));
    }
    return distance;
  }

  pointSize(height) {
    return (0.008 * box.radius * height) / (2 * Math.tan(Orbit.FOV / 2));
  }

  turn(dx, dy) {
    this.azimuth -= dx * 0.007;
    this.elevation = clamp(this.elevation + dy * 0.007, -1.5, 1.5);
  }

  pan(dx, dy) {
    const { right, up } = this.axes(), step = this.pixel * this.distance;
    this.target = add(this.target, add(scaled(right, -dx * step), scaled(up, dy * step)));
  }

  zoom(factor) {
    this.distance = clamp(this.distance * factor, 0.02 * box.radius, 40 * box.radius);
  }
}
Orbit.FOV = Math.PI / 4;

class FromAbove {
  constructor(onDraw) {
    this.near = 1e-4;
    this.onDraw = onDraw;
    this.reset();
  }

  reset() {
    this.middle = boxAbove.middle.slice(0, 2);
    this.pixel = null; // units a pixel, until the shape of the canvas is known
  }

  clipView(width, height) {
    // at least as much as the lines of sight reach, where nothing has moved
    if (this.pixel === null) this.pixel = 1.08 * Math.max(boxAbove.size[0] / width, boxAbove.size[1] / (height - 40), (0.4 * boxAbove.radius) / height);
    [this.width, this.height] = [width, height];
    const sx = 2 / (width * this.pixel), sy = 2 / (height * this.pixel), sz = 0.05 / box.radius;
    return new Float32Array([
      sx, 0, 0, 0, 0, sy, 0, 0, 0, 0, -sz, 0,
      -this.middle[0] * sx, -this.middle[1] * sy, box.middle[2] * sz, 1,
    ]);
  }

  pointSize() {
    return clamp((0.004 * box.radius) / this.pixel, 1.6, 4);
  }

  pan(dx, dy) {
    this.middle[0] -= dx * this.pixel;
    this.middle[1] += dy * this.pixel;
  }

  zoom(factor, x, y) {
    const held = Math.min(Math.max(this.pixel * factor, 1e-5 * box.radius), box.radius) / this.pixel;
    const [u, v] = [(x - this.width / 2) * this.pixel, (this.height / 2 - y) * this.pixel];
    this.middle[0] += u * (1 - held);
    this.middle[1] += v * (1 - held);
    this.pixel *= held;
  }
}
