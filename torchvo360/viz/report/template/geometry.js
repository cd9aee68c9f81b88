// Small vectors and matrices. A 4 x 4 matrix is a Float32Array by columns, as WebGL takes it; a 3 x 3 one is nine numbers by rows.

const add = (p, q) => [p[0] + q[0], p[1] + q[1], p[2] + q[2]];
const scaled = (p, s) => [p[0] * s, p[1] * s, p[2] * s];
const subtract = (p, q) => add(p, scaled(q, -1));
const dot = (p, q) => p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
const cross = (p, q) => [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
const unitVector = (p) => scaled(p, 1 / (Math.hypot(...p) || 1));
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
const column = (R, k) => [R[k], R[3 + k], R[6 + k]];
const turned = (R, p) => [dot(R.slice(0, 3), p), dot(R.slice(3, 6), p), dot(R.slice(6, 9), p)];
const turnedBack = (R, p) => [dot(column(R, 0), p), dot(column(R, 1), p), dot(column(R, 2), p)];

function product(A, B) {
  const C = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let k = 0; k < 4; k++) C[4 * column + row] += A[4 * k + row] * B[4 * column + k];
  return C;
}

function rotation(quaternion) {
  const [x, y, z, w] = quaternion;
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
    2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
    2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
  ];
}

// From the run's world into the axes that are shown: x right, y ahead, z up.
const S = content.view_world;
const shownScale = Math.hypot(S[0], S[4], S[8]);
const R_view_world = [S[0], S[1], S[2], S[4], S[5], S[6], S[8], S[9], S[10]].map((value) => value / shownScale);

function shownPositions(xyz) {
  const out = new Float32Array(xyz.length);
  for (let i = 0; i < xyz.length; i += 3)
    for (let row = 0; row < 3; row++)
      out[i + row] = S[4 * row] * xyz[i] + S[4 * row + 1] * xyz[i + 1] + S[4 * row + 2] * xyz[i + 2] + S[4 * row + 3];
  return out;
}

const path = shownPositions(frames.position);
const pathAt = (row) => [path[3 * row], path[3 * row + 1], path[3 * row + 2]];

function R_view_cam(row) {
  const R_world_cam = rotation(frames.rotation.subarray(4 * row, 4 * row + 4));
  const columns = [0, 1, 2].map((k) => turned(R_view_world, column(R_world_cam, k)));
  return [0, 1, 2].flatMap((row) => columns.map((axis) => axis[row]));
}

function quantile(values, share) {
  const sorted = Float32Array.from(values).sort();
  return sorted.length ? sorted[Math.round(share * (sorted.length - 1))] : NaN;
}

// The box of the path and of most of the points: a few far ones shall not make all else small.
function extent(clouds) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const [xyz, share] of clouds)
    for (let axis = 0; axis < 3; axis++) {
      const values = xyz.filter((_, i) => i % 3 === axis && Number.isFinite(xyz[i]));
      if (!values.length) continue;
      low[axis] = Math.min(low[axis], quantile(values, share));
      high[axis] = Math.max(high[axis], quantile(values, 1 - share));
    }
  const size = [0, 1, 2].map((axis) => high[axis] - low[axis]), radius = Math.hypot(...size) / 2;
  const middle = [0, 1, 2].map((axis) => (low[axis] + high[axis]) / 2);
  return { low, high, size, middle, radius: radius > 1e-9 ? radius : 1 }; // a single place has any size
}

// The largest of 1, 2 and 5 times a power of ten that is at most this.
function roundStep(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [5, 2, 1].find((step) => step * power <= value * 1.0000001);
}
