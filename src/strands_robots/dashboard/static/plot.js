// The last 30 seconds of all joints on a canvas, on an axis in their unit, or in shares of their ranges.
import { S } from "./strings.js";
import { limitsOf, unitOf } from "./units.js";

const SECONDS = 30;
const LEFT = 44, BOTTOM = 18, TOP = 6, RIGHT = 6;
export const PLOTTED_MAX = 12;

export class Plot {
  constructor(canvas) {
    this.canvas = canvas;
    this.samples = [];
    this.asked = false;
  }

  reset(history) { this.samples = history.slice(); this.ask(); }

  add(at, joints) {
    this.samples.push([at, joints]);
    while (this.samples.length && this.samples[0][0] < at - SECONDS) this.samples.shift();
    this.ask();
  }

  ask() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => { this.asked = false; this.draw(); });
  }

  names() {
    const last = this.samples[this.samples.length - 1], names = [];
    if (last) for (const part of Object.keys(last[1])) for (const name of Object.keys(last[1][part])) names.push([part, name]);
    return names.slice(0, PLOTTED_MAX);
  }

  // One unit for all is the axis; several are drawn as shares of each joint's range.
  axis(names) {
    const units = new Set(names.map((each) => unitOf(this.units, each[1]).text));
    if (units.size !== 1) return { low: 0, high: 100, text: "%", of: (name, value) => { const [low, high] = limitsOf(this.limits, this.units, name); return 100 * (value - low) / (high - low); } };
    const unit = unitOf(this.units, names[0][1]);
    const ranges = names.map((each) => limitsOf(this.limits, this.units, each[1]));
    return {
      low: Math.min(...ranges.map((each) => each[0])) * unit.factor, high: Math.max(...ranges.map((each) => each[1])) * unit.factor,
      text: unit.text, of: (_, value) => value * unit.factor,
    };
  }

  draw() {
    const canvas = this.canvas;
    const width = canvas.clientWidth, height = canvas.clientHeight, ratio = window.devicePixelRatio || 1;
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio)) { canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio); }
    const pen = canvas.getContext("2d"), style = getComputedStyle(canvas);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const names = this.names();
    const axis = names.length ? this.axis(names) : { low: -180, high: 180, text: "\u00b0" };
    const across = (seconds) => LEFT + (width - LEFT - RIGHT) * (1 - seconds / SECONDS);
    const up = (value) => TOP + (height - TOP - BOTTOM) * (1 - Math.min(1, Math.max(0, (value - axis.low) / (axis.high - axis.low))));
    this.drawGrid(pen, style, axis, across, up, width, height);
    const last = this.samples[this.samples.length - 1];
    names.forEach(([part, name], index) => {
      pen.strokeStyle = style.getPropertyValue(`--plot-${index % 6}`);
      pen.lineWidth = 1.5;
      pen.setLineDash(index < 6 ? [] : [4, 3]);
      pen.beginPath();
      let begun = false, points = 0;
      for (const [at, joints] of this.samples) {
        const value = joints[part] && joints[part][name];
        if (typeof value !== "number") { begun = false; continue; }
        const x = across(last[0] - at), y = up(axis.of(name, value));
        if (begun) pen.lineTo(x, y); else pen.moveTo(x, y);
        begun = true;
        points += 1;
        // One sample makes no line: a robot that is idle was read once.
        if (points === 1) { pen.fillStyle = pen.strokeStyle; pen.fillRect(Math.min(x, width - RIGHT - 5), y - 2, 5, 4); }
      }
      pen.stroke();
    });
    pen.setLineDash([]);
  }

  drawGrid(pen, style, axis, across, up, width, height) {
    pen.strokeStyle = style.getPropertyValue("--line");
    pen.fillStyle = style.getPropertyValue("--soft");
    pen.font = "11px system-ui, sans-serif";
    pen.lineWidth = 1;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    const step = stepOf(axis.high - axis.low);
    for (let value = Math.ceil(axis.low / step) * step; value <= axis.high; value += step) {
      const y = up(value);
      pen.beginPath(); pen.moveTo(LEFT, y); pen.lineTo(width - RIGHT, y); pen.stroke();
      pen.fillText(`${Number(value.toPrecision(6))}${axis.text === "\u00b0" ? "" : "\u00a0"}${axis.text.slice(0, 2)}`, LEFT - 4, y);
    }
    pen.textBaseline = "bottom";
    for (let second = 0; second <= SECONDS; second += 10) {
      const x = across(second);
      pen.beginPath(); pen.moveTo(x, TOP); pen.lineTo(x, height - BOTTOM); pen.stroke();
      pen.textAlign = second === 0 ? "right" : second === SECONDS ? "left" : "center";
      pen.fillText(second === 0 ? S.now : S.ago(second), x, height - 1);
    }
  }
}

// About four lines: 1, 2 or 5 times a power of ten, or 45 degrees and 90 for a turn.
function stepOf(range) {
  if (range > 250 && range < 800) return 90;
  const rough = range / 4, power = 10 ** Math.floor(Math.log10(rough));
  return ([1, 2, 5].find((each) => each * power >= rough) || 10) * power;
}
