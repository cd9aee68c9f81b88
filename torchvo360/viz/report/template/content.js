// The page's content: typed arrays out of base64, and numbers in words.

const ARRAYS = { float64: Float64Array, float32: Float32Array, int32: Int32Array, uint16: Uint16Array, uint8: Uint8Array };

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

function unpacked(field) {
  return new ARRAYS[field.type](bytesOf(field.base64).buffer);
}

const content = JSON.parse(document.getElementById("content").textContent);
const frames = Object.fromEntries(
  Object.entries(content.frames).map(([name, field]) => [name, field && field.base64 !== undefined ? unpacked(field) : field]),
);
frames.count = frames.index.length;
const errors = content.errors && {
  position_m: unpacked(content.errors.position_m),
  rotation_deg: unpacked(content.errors.rotation_deg),
};
const rowOfIndex = new Map(Array.from(frames.index, (index, row) => [index, row]));
const unit = content.unit;

const element = (id) => document.getElementById(id);

function made(tag, text, className) {
  const node = document.createElement(tag);
  if (text !== undefined) node.textContent = text;
  if (className) node.className = className;
  return node;
}

const MINUS = "\u2212", NONE = "\u2013", NARROW = "\u202f";

// Four digits at most, and a true minus sign; a dash where there is no number.
function word(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return NONE;
  const size = Math.abs(value);
  let text;
  if (size === 0) text = "0";
  else if (size < 1e-4 || size >= 1e6) text = value.toExponential(Math.max(0, digits - 1));
  else text = size >= 10 ** digits ? value.toFixed(0) : String(Number(value.toPrecision(digits)));
  return text.replace("-", MINUS);
}

function thousands(value) {
  return String(value).replace(/\B(?=(\d{3})+$)/g, NARROW);
}

function duration(seconds, digits = 2) {
  const sign = seconds < 0 ? MINUS : "", size = Math.abs(seconds);
  if (size < 60) return `${sign}${size.toFixed(digits)}${NARROW}s`;
  const minutes = Math.floor(size / 60);
  return `${sign}${minutes}:${(size - 60 * minutes).toFixed(digits).padStart(3 + digits, "0")}`;
}

const inUnit = (length) => `${word(length)}${NARROW}${unit === "units" && length === 1 ? "unit" : unit}`;

const stateOf = (row) => frames.states[frames.state[row]];
const reasonOf = (row) => frames.reasons[frames.reason[row]];

function rowAt(seconds) {
  let low = 0, high = frames.count - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (frames.seconds[middle] < seconds) low = middle + 1;
    else high = middle;
  }
  if (low > 0 && seconds - frames.seconds[low - 1] < frames.seconds[low] - seconds) low--;
  return low;
}

const STATES = ["tracking", "weak", "lost", "relocalised", "initialising"];

function themeColour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function stateColour(state) {
  return themeColour(STATES.includes(state) ? state : "other");
}

// "#rrggbb" as red, green, blue and opacity, 0 to 1
function rgba(hex, opacity = 1) {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255).concat(opacity);
}
