// What both views of the world draw: points, path, truth, loops and the picked frame.

const cloudShown = (() => {
  const xyz = shownPositions(unpacked(content.points.xyz));
  const rgb = unpacked(content.points.rgb);
  const frame = Float32Array.from(unpacked(content.points.frame));
  const colour = new Uint8Array((xyz.length / 3) * 4).fill(255);
  for (let i = 0; i < frame.length; i++) colour.set(rgb.subarray(3 * i, 3 * i + 3), 4 * i);
  return { xyz, colour, frame, eyeLevel: unpacked(content.points.eye_level) };
})();

const truthShown = content.truth && unpacked(content.truth.shown);
const beforeShown = content.before_loops && shownPositions(unpacked(content.before_loops));
const paths = truthShown ? [[path, 0], [truthShown, 0]] : [[path, 0]];
const box = extent([...paths, [cloudShown.xyz, 0.12]]);

function selection(cloud, keep) {
  const rows = [...cloud.frame.keys()].filter((i) => keep[i]);
  return {
    xyz: Float32Array.from(rows.flatMap((i) => [...cloud.xyz.subarray(3 * i, 3 * i + 3)])),
    colour: Uint8Array.from(rows.flatMap((i) => [...cloud.colour.subarray(4 * i, 4 * i + 4)])),
    frame: Float32Array.from(rows, (i) => cloud.frame[i]),
  };
}

const MOST_SEGMENTS = 4000; // more are finer than a screen shows

// Through every n-th place, the last, and those where `needed` says so.
function polyline(xyz, colourAt, frameAt = () => 0, needed = () => false) {
  const out = [], count = xyz.length / 3, stride = Math.ceil(count / MOST_SEGMENTS);
  let from = xyz.subarray(0, 3);
  for (let i = 1; i < count; i++) {
    if (i % stride && i !== count - 1 && !needed(i)) continue;
    const to = xyz.subarray(3 * i, 3 * i + 3);
    if ([...from, ...to].every(Number.isFinite)) out.push([from, to, colourAt(i), frameAt(i)]);
    from = to;
  }
  return out;
}

const cloudAtEyeLevel = selection(cloudShown, cloudShown.eyeLevel);
const boxAbove = extent([...paths, [cloudAtEyeLevel.xyz, 0.05]]);

class Scene {
  // view: an object with clipView(width, height), pointSize(height), reset(), and the moves of `listen`
  constructor(canvas, view, { cloud, floor, onPick }) {
    this.canvas = canvas;
    this.view = view;
    this.painter = new Painter(canvas);
    this.cloud = this.painter.cloud(cloud.xyz, cloud.colour, cloud.frame);
    this.growth = clamp(Math.sqrt(16000 / Math.max(cloud.frame.length, 1)), 1, 1.8); // few points are drawn larger
    this.floor = floor;
    this.shown = { points: true, soFar: false };
    this.picked = { row: 0, look: null, fov: 0 };
    this.touched = false;
    const moved = (move) => (...values) => { move.apply(view, values); this.touched = true; this.redraw(); };
    listen(canvas, {
      turn: view.turn && moved(view.turn),
      pan: moved(view.pan),
      zoom: moved(view.zoom),
      click: (x, y, touch) => {
        const row = this.nearest(x, y, touch ? 28 : 18);
        if (row >= 0) onPick(row);
      },
    });
    new ResizeObserver(() => { if (this.touched) this.redraw(); else this.reset(); }).observe(canvas);
    this.recolour();
  }

  // Shows all; until the view is touched this holds for another shape of the canvas, too.
  reset() {
    this.touched = false;
    this.view.reset();
    this.redraw();
  }

  // Lines carry their colours: they are made anew when the theme changes.
  recolour() {
    const { painter } = this;
    painter.release(this.path, this.truth, this.before, this.loops, this.grid);
    const colours = Object.fromEntries(frames.states.map((state) => [state, rgba(stateColour(state))]));
    const changes = (row) => frames.state[row] !== frames.state[row + 1];
    this.path = painter.segments(polyline(path, (row) => colours[stateOf(row)], (row) => frames.index[row], changes));
    const plain = (name, opacity) => { const colour = rgba(themeColour(name), opacity); return () => colour; };
    this.truth = painter.segments(truthShown ? polyline(truthShown, plain("truth", 0.75)) : []);
    this.before = painter.segments(beforeShown ? polyline(beforeShown, plain("before", 0.8)) : []);
    this.loops = painter.segments(
      content.loops.map((edge) => edge.map((index) => rowOfIndex.get(index))).filter((rows) => rows.every((row) => row !== undefined))
        .map(([i, j]) => [pathAt(i), pathAt(j), rgba(themeColour("loop"), 0.8), 0]),
    );
    this.grid = painter.segments(this.floor ? gridLines(this.floor) : []);
    this.redraw();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.draw(); });
  }

  pick(row, look, fov) {
    this.picked = { row, look, fov };
    this.redraw();
  }

  draw() {
    const { painter, view, canvas } = this;
    if (!canvas.clientWidth) return;
    const ratio = painter.fit();
    painter.clear();
    const clip = view.clipView(canvas.clientWidth, canvas.clientHeight);
    const until = this.shown.soFar ? frames.index[this.picked.row] : Infinity;
    const line = (lines, width, options = {}) => painter.lines(lines, clip, { width: 2 * width * ratio, near: view.near, ...options });
    line(this.grid, 0.5);
    if (this.shown.points) {
      const size = view.pointSize(canvas.clientHeight) * this.growth * ratio;
      const lift = document.documentElement.dataset.theme === "dark" ? 0.68 : 0.85; // colours of indoor light are dark
      painter.points(this.cloud, clip, { until, worldSize: size, least: 1.1 * this.growth * ratio, most: 6 * ratio, lift });
    }
    const gl = painter.gl;
    gl.clear(gl.DEPTH_BUFFER_BIT); // the path is seen through the points
    line(this.truth, 3.2, { depth: false });
    line(this.before, 0.7, { depth: false });
    line(this.loops, 0.7, { depth: false });
    line(this.path, 1.25, { depth: false, until });
    this.drawMarks(clip, ratio);
    view.onDraw?.(this);
  }

  drawMarks(clip, ratio) {
    const { painter } = this, { row, look, fov } = this.picked;
    const mark = rgba(themeColour("mark")), surface = rgba(themeColour("surface"));
    const sprite = (at, size, shape, fill, rim) => {
      const cloud = painter.cloud(Float32Array.from(at), Uint8Array.from(fill, (value) => 255 * value), new Float32Array(1));
      painter.points(cloud, clip, { least: size * ratio, most: size * ratio, shape, rim, depth: false });
      painter.release(cloud);
    };
    sprite(pathAt(0), 11, 1, surface, mark);
    sprite(pathAt(frames.count - 1), 10, 2, mark, mark);
    const sight = painter.segments(sightLines(row, look, fov, 0.16 * box.radius, [...mark.slice(0, 3), 0.85]));
    painter.lines(sight, clip, { width: 3 * ratio, near: this.view.near, depth: false });
    painter.release(sight);
    sprite(pathAt(row), 15, 1, rgba(stateColour(stateOf(row))), mark);
  }

  // The row of the frame whose place on the screen is nearest, -1 where none is within a distance in pixels.
  nearest(x, y, within) {
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    const clip = this.view.clipView(width, height);
    let best = -1, least = within;
    for (let row = 0; row < frames.count; row++) {
      const [px, py, pz] = pathAt(row);
      const w = clip[3] * px + clip[7] * py + clip[11] * pz + clip[15];
      if (!(w > 0)) continue;
      const u = ((clip[0] * px + clip[4] * py + clip[8] * pz + clip[12]) / w + 1) * 0.5 * width;
      const v = (1 - (clip[1] * px + clip[5] * py + clip[9] * pz + clip[13]) / w) * 0.5 * height;
      const distance = Math.hypot(u - x, v - y);
      if (distance < least) [best, least] = [row, distance];
    }
    return best;
  }
}

// Where the picked camera looks: the sides of the panorama's view, or the pyramid of a pinhole's image.
function sightLines(row, look, fov, length, colour) {
  const at = pathAt(row), R = R_view_cam(row);
  if (content.camera.panorama) {
    if (!look) return [];
    const side = unitVector(cross(look, [0, 0, 1])), reach = Math.min(Math.tan(fov / 2), 1.5);
    return [-1, 1].map((sign) => [at, add(at, scaled(unitVector(add(look, scaled(side, sign * reach))), length)), colour, 0]);
  }
  const [fx, fy, cx, cy] = content.camera.intrinsics, { width, height } = content.camera;
  const corners = [[0, 0], [width, 0], [width, height], [0, height]].map(([u, v]) =>
    add(at, scaled(turned(R, [(u - cx) / fx, (v - cy) / fy, 1]), 0.7 * length)));
  return corners.flatMap((corner, k) => [[at, corner, colour, 0], [corner, corners[(k + 1) % 4], colour, 0]]);
}

function gridLines({ height, step }) {
  const colour = rgba(themeColour("grid")), out = [];
  const range = [0, 1].map((axis) => [Math.floor(box.low[axis] / step) - 1, Math.ceil(box.high[axis] / step) + 1]);
  for (const axis of [0, 1])
    for (let k = range[axis][0]; k <= range[axis][1]; k++) {
      const from = [0, 0, height], to = [0, 0, height];
      from[axis] = to[axis] = k * step;
      [from[1 - axis], to[1 - axis]] = range[1 - axis].map((value) => value * step);
      out.push([from, to, colour, 0]);
    }
  return out;
}
