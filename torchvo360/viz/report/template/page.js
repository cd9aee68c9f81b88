// The page: what is picked, and everything that shows it.

const summary = content.summary;
let picked = -1, timer = null;

// Theme: the system's, which the page's head has set, until the button is used.
const root = document.documentElement, dark = matchMedia("(prefers-color-scheme: dark)");
function setTheme(theme) {
  root.dataset.theme = theme;
  for (const scene of scenes) scene.recolour();
  panorama?.redraw();
  charts.draw();
  drawStrip(element("strip"));
}
const followSystem = () => setTheme(dark.matches ? "dark" : "light");
dark.addEventListener("change", followSystem);
element("theme").addEventListener("click", () => {
  dark.removeEventListener("change", followSystem);
  setTheme(root.dataset.theme === "dark" ? "light" : "dark");
});

// Views
const floorStep = Math.max(roundStep(box.radius / 3), 1e-9);
const scenes = [], resets = [];
let panorama = null, plain = null;

function viewOf(id, make) {
  const canvas = element(id);
  try {
    return make(canvas);
  } catch (error) {
    canvas.hidden = true;
    canvas.parentElement.append(made("p", "This view needs WebGL 2, which this browser does not offer here.", "empty"));
    return null;
  }
}

const above = new FromAbove(({ canvas }) => {
  const length = roundStep(above.pixel * Math.min(canvas.clientWidth * 0.35, 180));
  element("plan-bar").style.width = `${length / above.pixel}px`;
  element("plan-scale").textContent = inUnit(length);
});
const orbit = new Orbit();
for (const [id, view, options] of [
  ["scene", orbit, { cloud: cloudShown, floor: { height: Math.min(quantile(cloudShown.xyz.filter((_, i) => i % 3 === 2), 0.05) || 0, box.low[2]), step: floorStep } }],
  ["plan", above, { cloud: cloudAtEyeLevel }],
]) {
  const scene = viewOf(id, (canvas) => new Scene(canvas, view, { ...options, onPick: (row) => pick(row) }));
  if (!scene) continue;
  scenes.push(scene);
  element(`${id}-reset`).addEventListener("click", () => scene.reset());
}
element("scene-scale").textContent = `grid: ${inUnit(floorStep)}`;

const pictures = new Pictures(content.pictures);
const isPanorama = content.camera.panorama;
for (const node of document.querySelectorAll(".only-360")) node.hidden = !isPanorama || !pictures.list.length;
element("picture").hidden = isPanorama || !pictures.list.length;
element("no-picture").hidden = pictures.list.length > 0;
element("no-picture").textContent = "No pictures of the frames were kept.";
if (isPanorama && pictures.list.length)
  panorama = viewOf("panorama", (canvas) => new Panorama(canvas, pictures, (ahead, view) => {
    for (const scene of scenes) scene.pick(picked, ahead, view.fov);
    const degrees = (angle) => `${(Math.round((angle * 180) / Math.PI)).toString().replace("-", MINUS)}°`;
    element("look").textContent = `right ${degrees(Math.atan2(Math.sin(view.yaw), Math.cos(view.yaw)))} · up ${degrees(view.pitch)} · view ${degrees(view.fov)}`;
  }));
else if (pictures.list.length) plain = new PlainPicture(element("picture"), pictures);
element("steady").addEventListener("change", (event) => panorama?.setSteady(event.target.checked));
element("overlay").addEventListener("change", (event) => { if (panorama) { panorama.overlay = event.target.checked; panorama.redraw(); } });
element("picture-reset").addEventListener("click", () => panorama?.reset());
for (const [id, name] of [["show-points", "points"], ["so-far", "soFar"]])
  element(id).addEventListener("change", (event) => {
    for (const scene of scenes) { scene.shown[name] = event.target.checked; scene.redraw(); }
  });

const charts = new Charts(element("charts"), (row) => pick(row));
new ResizeObserver(() => drawStrip(element("strip"))).observe(element("strip"));

// The picked frame
function pick(row) {
  row = clamp(Math.round(row), 0, frames.count - 1);
  if (row === picked) return;
  const first = picked < 0;
  picked = row;
  const state = stateOf(row), [reason, meaning] = reasonOf(row);
  const slider = element("slider");
  slider.value = row;
  slider.setAttribute("aria-valuetext", `frame ${frames.index[row]}, ${duration(frames.seconds[row])}, ${state}`);
  element("where").replaceChildren(`Frame ${frames.index[row]} · ${duration(frames.seconds[row])} `, stateMark(state), state);
  for (const scene of scenes) scene.pick(row, scene.picked.look, scene.picked.fov);
  panorama?.show(row);
  if (first) panorama?.reset();
  plain?.show(row);
  charts.pick(row);
  const near = pictures.nearest(row);
  element("picture-note").textContent = near < 0 || pictures.rows[near] === row ? "" : `picture of frame ${pictures.list[near].index}, the nearest one kept`;
  const position = [0, 1, 2].map((axis) => word(frames.position[3 * row + axis], 4)).join(", ");
  const rows = [
    ["State", state], ["Residual", word(frames.residual[row])], ["Inliers", word(frames.inliers[row])],
    ["Gain a", word(frames.a[row])], ["Offset b", word(frames.b[row])], ["Time", `${word(frames.milliseconds[row])} ms`],
  ];
  if (errors) rows.push(["Position error", `${word(errors.position_m[row])} m`], ["Rotation error", `${word(errors.rotation_deg[row])}°`]);
  rows.push(["Position x, y, z, as in trajectory.txt", position, "wide"], ["Reason", meaning ? `${reason}: ${meaning}` : reason, "wide"]);
  fill(element("frame"), rows);
  markChange(row);
}

function stateMark(state) {
  const mark = made("i", undefined, "dot");
  mark.style.background = `var(--${STATES.includes(state) ? state : "other"})`;
  return mark;
}

function fill(list, rows) {
  list.replaceChildren(...rows.map(([term, text, className]) => {
    const pair = made("div", undefined, className);
    pair.append(made("dt", term), typeof text === "string" ? made("dd", text) : text);
    return pair;
  }));
}

// Time
function play(on) {
  cancelAnimationFrame(timer);
  timer = null;
  element("play").setAttribute("aria-pressed", String(on));
  element("play").setAttribute("aria-label", on ? "Pause" : "Play");
  if (!on) return;
  if (picked === frames.count - 1) pick(0);
  const start = performance.now(), from = frames.seconds[picked];
  const step = (now) => {
    const seconds = from + (now - start) / 1000;
    pick(rowAt(Math.min(seconds, duringEnd)));
    if (seconds >= duringEnd) play(false);
    else timer = requestAnimationFrame(step);
  };
  timer = requestAnimationFrame(step);
}
const stepTo = (row) => { play(false); pick(row); };
element("slider").max = frames.count - 1;
element("slider").addEventListener("input", (event) => stepTo(Number(event.target.value)));
element("play").addEventListener("click", () => play(timer === null));
element("back").addEventListener("click", () => stepTo(picked - 1));
element("on").addEventListener("click", () => stepTo(picked + 1));
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input[type=search]")) return;
  const steps = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10, Home: -Infinity, End: Infinity };
  const inList = event.target.closest(".scroll") !== null;
  if (event.key in steps && !event.shiftKey && !(inList && !event.key.startsWith("Arrow"))) stepTo(clamp(picked + steps[event.key], 0, frames.count - 1));
  else if (event.key === " " && !event.target.closest("button, input, summary, .scroll")) play(timer === null);
  else return;
  event.preventDefault();
});

// Changes of state
const changes = [];
for (let row = 0; row < frames.count; row++)
  if (row === 0 || frames.state[row] !== frames.state[row - 1] || frames.reason[row] !== frames.reason[row - 1]) changes.push(row);
const changeRows = changes.map((row) => {
  const line = made("tr"), state = stateOf(row), [reason, meaning] = reasonOf(row);
  const index = made("td"), button = made("button", String(frames.index[row]));
  button.type = "button";
  button.setAttribute("aria-label", `Pick frame ${frames.index[row]}`);
  index.append(button);
  const stateCell = made("td"), why = made("td");
  stateCell.append(stateMark(state), state);
  why.append(made("code", reason), meaning ? ` ${meaning}` : "");
  line.append(made("td", duration(frames.seconds[row])), index, stateCell, why);
  line.addEventListener("click", () => stepTo(row));
  return line;
});
element("changes").tBodies[0].replaceChildren(...changeRows);
element("changes-count").textContent = changes.length === 1 ? "none" : `${changes.length - 1}`;
function markChange(row) {
  let now = changes.length - 1;
  while (now > 0 && changes[now] > row) now--;
  changeRows.forEach((line, k) => line.classList.toggle("now", k === now));
}

// What is known of the whole
element("name").textContent = content.name;
element("subtitle").textContent =
  `${thousands(frames.count)} ${frames.count === 1 ? "frame" : "frames"} of ${content.camera.width} × ${content.camera.height}, ${duration(frames.seconds[frames.count - 1], 1)}`;

function figure(value, after) {
  const node = made("dd", value);
  if (after) node.append(made("small", after));
  return node;
}
let pathLength = 0;
for (let row = 1; row < frames.count; row++) pathLength += Math.hypot(...subtract(pathAt(row), pathAt(row - 1)));
const tracked = [...frames.state].filter((state) => ["tracking", "relocalised"].includes(frames.states[state])).length;
const figures = [
  ["Tracked", figure(`${word((100 * tracked) / frames.count)}%`, `${thousands(tracked)} of ${thousands(frames.count)}`)],
  ["Path", figure(word(pathLength), unit)],
  ["Map", figure(thousands(content.points.total), `points, ${summary.keyframes ?? NONE} keyframes`)],
];
if (summary.maps > 1) figures.push(["Maps", figure(String(summary.maps))]);
if (content.loops.length) figures.push(["Loops closed", figure(String(content.loops.length))]);
if (Number.isFinite(summary.ate_rmse_m)) figures.push(["ATE", figure(word(summary.ate_rmse_m), `m, ${word(summary.ate_percent)}%`)]);
if (Number.isFinite(summary.rotation_median_deg)) figures.push(["Rotation error", figure(`${word(summary.rotation_median_deg)}°`, "median")]);
if (Number.isFinite(summary.fps)) figures.push(["Speed", figure(word(summary.fps), "frames/s")]);
fill(element("figures"), figures);

const legend = frames.states.map((state) => [stateMark(state), state]);
if (truthShown) legend.push(["truth", "truth"]);
if (beforeShown) legend.push(["before", "before loops"]);
if (content.loops.length) legend.push(["loop", "loop"]);
element("legend").replaceChildren(...[...legend, ["round", "start"], ["square", "end"]].map(([mark, text]) => {
  const item = made("li");
  if (typeof mark === "string") {
    const sign = made("i", undefined, mark);
    if (!["round", "square"].includes(mark)) sign.style.background = `var(--${mark})`;
    mark = sign;
  } else mark.className = "";
  item.append(mark, text);
  return item;
}));

element("notes").replaceChildren(...(summary.notes || []).map((note) => made("li", note)));
const about = [
  ["Input", summary.input], ["Camera", summary.camera && `${summary.camera.model}, ${content.camera.width} × ${content.camera.height}`],
  ["States", Object.entries(summary.states || {}).map(([state, count]) => `${count} ${state}`).join(", ")],
  ["Unusable frames", Object.entries(summary.unusable_frames || {}).map(([problem, count]) => `${count} ${problem}`).join(", ")],
  ["Coverage", Number.isFinite(summary.coverage) && `${word(100 * summary.coverage)}%`],
  ["Errors", errors && `RPE ${word(summary.rpe_translation_percent)}% and ${word(summary.rpe_rotation_deg)}°, scale ${word(summary.scale, 4)}`],
  ["Unit", summary.metric ? "metres" : content.points.total > 0 && `${errors ? "metres by the true poses; the run's own is " : ""}the median range that the first keyframe saw`],
  ["Gravity", summary.gravity && `${summary.gravity.map((value) => word(value, 4)).join(", ")} m/s² in the world's axes`],
  ["Duration", Number.isFinite(summary.seconds) && `${word(summary.seconds)} s, threads: ${summary.threads}`],
  ["Versions", Object.entries(summary.versions || {}).map(([name, version]) => `${name} ${version}`).join(", ")],
];
for (const [term, text] of about) if (text) element("run").append(made("dt", term), made("dd", text));

const settingRows = [...content.settings].sort((p, q) => p[2] - q[2]).map(([name, value, usual]) => {
  const line = made("tr", undefined, usual ? undefined : "changed");
  line.append(made("td", name), made("td", value));
  return line;
});
element("settings").tBodies[0].replaceChildren(...settingRows);
const changedCount = content.settings.filter(([, , usual]) => !usual).length;
element("settings-count").textContent = `${content.settings.length}, ${changedCount} not the usual ones`;
element("settings-filter").addEventListener("input", (event) => {
  const wanted = event.target.value.toLowerCase();
  settingRows.forEach((line) => { line.hidden = !line.textContent.toLowerCase().includes(wanted); });
});

pick(0);
