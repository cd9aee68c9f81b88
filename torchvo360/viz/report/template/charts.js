// Values over time, one small chart each, with the states behind them and one line for the picked frame.

const duringEnd = Math.max(frames.seconds[frames.count - 1], 1e-9);

const SERIES = [
  ["position_m", "Position error (m)", errors?.position_m],
  ["rotation_deg", "Rotation error (°)", errors?.rotation_deg],
  ["residual", "Residual (intensity)", frames.residual],
  ["inliers", "Inliers (share)", frames.inliers],
  ["a", "Brightness gain a (log)", frames.a],
  ["b", "Brightness offset b (intensity)", frames.b],
  ["milliseconds", "Time per frame (ms)", frames.milliseconds],
].filter(([, , values]) => values && values.some(Number.isFinite));

function stretches() {
  const out = [];
  for (let row = 0; row < frames.count; row++) {
    const last = out[out.length - 1];
    if (last && last.state === frames.state[row]) last.to = row;
    else out.push({ state: frames.state[row], from: row, to: row });
  }
  return out;
}

const stateStretches = stretches();
const betweenRows = (row, step) => {
  const other = clamp(row + step, 0, frames.count - 1);
  return (frames.seconds[row] + frames.seconds[other]) / 2;
};

function canvasContext(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2), width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = Math.max(1, Math.round(width * ratio));
  canvas.height = Math.max(1, Math.round(height * ratio));
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  return { context, width, height };
}

class Charts {
  constructor(parent, onPick) {
    this.row = 0;
    this.hovered = null;
    this.charts = SERIES.map(([name, label, values]) => {
      const node = made("div", undefined, "chart"), head = made("div", undefined, "head");
      const value = made("b"), canvas = made("canvas");
      const most = made("span", undefined, "most");
      head.append(made("span", label), most, value);
      canvas.id = `chart-${name}`;
      canvas.setAttribute("role", "img");
      const finite = values.filter(Number.isFinite);
      const low = finite.reduce((p, q) => Math.min(p, q)), high = finite.reduce((p, q) => Math.max(p, q));
      canvas.setAttribute("aria-label", `${label} over time: from ${word(low)} to ${word(high)}, median ${word(quantile(finite, 0.5))}`);
      most.textContent = `max ${word(high)}`;
      node.append(head, canvas);
      parent.append(node);
      this.listen(canvas, onPick);
      const zero = !["a", "b"].includes(name);
      const floor = zero ? 0 : Math.min(low, 0), room = Math.max(high - floor, 1e-6 * Math.abs(high), 1e-12);
      return { canvas, value, values, low: floor - (zero ? 0 : 0.08 * room), high: Math.max(high, floor) + 0.08 * room };
    });
    this.axis = made("canvas");
    this.axis.id = "axis";
    this.axis.setAttribute("aria-hidden", "true");
    parent.append(this.axis);
    new ResizeObserver(() => this.draw()).observe(parent);
  }

  listen(canvas, onPick) {
    const rowOf = (event) => {
      const box = canvas.getBoundingClientRect();
      return rowAt(((event.clientX - box.left) / box.width) * duringEnd);
    };
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons) onPick(rowOf(event));
      this.hovered = event.buttons ? null : rowOf(event);
      this.draw();
    });
    canvas.addEventListener("pointerleave", () => { this.hovered = null; this.draw(); });
    canvas.addEventListener("click", (event) => onPick(rowOf(event)));
  }

  pick(row) {
    this.row = row;
    this.draw();
  }

  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      for (const chart of this.charts) this.drawOne(chart);
      this.drawAxis();
    });
  }

  drawOne({ canvas, value, values, low, high }) {
    const { context, width, height } = canvasContext(canvas);
    const x = (seconds) => (seconds / duringEnd) * width, y = (v) => height - 1 - ((v - low) / (high - low)) * (height - 3);
    for (const { state, from, to } of stateStretches) {
      if (frames.states[state] === "tracking") continue;
      context.fillStyle = stateColour(frames.states[state]);
      context.globalAlpha = 0.2;
      const left = x(betweenRows(from, -1));
      context.fillRect(left, 0, Math.max(x(betweenRows(to, 1)) - left, 1), height);
    }
    context.globalAlpha = 1;
    context.strokeStyle = themeColour("line");
    context.strokeRect(-1, y(Math.max(low, 0)), width + 2, 0);
    context.strokeStyle = context.fillStyle = themeColour("accent");
    context.lineWidth = 1.3;
    context.lineJoin = "round";
    context.beginPath();
    let drawing = false;
    for (let row = 0; row < frames.count; row++) {
      const known = Number.isFinite(values[row]);
      if (known) {
        const at = [x(frames.seconds[row]), y(values[row])];
        if (drawing) context.lineTo(...at);
        else context.moveTo(...at);
        if (!drawing && !Number.isFinite(values[row + 1])) context.rect(at[0] - 0.75, at[1] - 0.75, 1.5, 1.5);
      }
      drawing = known;
    }
    context.stroke();
    for (const [row, colour] of [[this.hovered, "soft"], [this.row, "mark"]]) {
      if (row === null) continue;
      const left = clamp(x(frames.seconds[row]), 0.75, width - 0.75);
      context.fillStyle = themeColour(colour);
      context.fillRect(left - 0.6, 0, 1.2, height);
      if (!Number.isFinite(values[row])) continue;
      context.beginPath();
      context.arc(left, y(values[row]), 3, 0, 7);
      context.fill();
    }
    value.textContent = word(values[this.hovered ?? this.row]);
  }

  drawAxis() {
    const { context, width } = canvasContext(this.axis);
    context.font = `11px ${getComputedStyle(document.body).fontFamily}`;
    context.fillStyle = themeColour("soft");
    context.textBaseline = "bottom";
    const step = Math.max(roundStep((duringEnd / width) * 110), 1e-9);
    for (let seconds = 0; seconds <= duringEnd * 1.0001; seconds += step) {
      const text = duration(seconds, Math.max(0, -Math.floor(Math.log10(step)))), wide = context.measureText(text).width;
      context.fillText(text, clamp((seconds / duringEnd) * width - wide / 2, 0, width - wide), 17);
    }
  }
}

function drawStrip(canvas) {
  const { context, width, height } = canvasContext(canvas);
  for (const { state, from, to } of stateStretches) {
    context.fillStyle = stateColour(frames.states[state]);
    // by rows, as the slider counts
    const step = frames.count > 1 ? width / (frames.count - 1) : 2 * width;
    context.fillRect((from - 0.5) * step, 0, Math.max((to - from + 1) * step, 1.5), height);
  }
}
