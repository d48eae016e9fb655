// Lines over time on a canvas, with clock times, a unit and a legend. Its size never changes.
import { el, setAttr, setText } from "./dom.js";
import { H } from "./history-strings.js";

const LEFT = 52, RIGHT = 8, TOP = 8, BOTTOM = 22;
const LEGEND_MAX = 16;

export function pen(canvas) {
  const width = canvas.clientWidth, height = canvas.clientHeight, ratio = window.devicePixelRatio || 1;
  if (!width || !height) return null;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const made = canvas.getContext("2d");
  made.setTransform(ratio, 0, 0, ratio, 0, 0);
  made.clearRect(0, 0, width, height);
  made.font = "12px system-ui, sans-serif";
  return [made, width, height, getComputedStyle(canvas)];
}

// Wall-clock times (ms) at round minutes, so far apart that their labels do not touch.
export function clockTicks(from, to, width) {
  const steps = [60, 120, 300, 600, 900].map((s) => s * 1000);
  const step = steps.find((each) => (to - from) / each * 56 <= width) || steps[4];
  const ticks = [];
  for (let at = Math.ceil(from / step) * step; at <= to; at += step) ticks.push(at);
  return ticks;
}

function niceRange(low, high) {
  if (low === high) { low -= 1; high += 1; }
  const rough = (high - low) / 4, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((each) => each * power).find((each) => each >= rough);
  return [Math.floor(low / step) * step, Math.ceil(high / step) * step, step];
}

export function short(value) {
  return Math.abs(value) >= 100 ? value.toFixed(0) : String(Number(value.toFixed(2)));
}

export class Chart {
  constructor(id, title) {
    this.title = title;
    this.head = el("h4", { id: `${id}-title`, text: title });
    this.canvas = el("canvas", { class: "chart", role: "img" });
    this.legend = el("ul", { class: "chart-legend", tabindex: 0, "aria-label": `${title}: ${H.legend}` });
    this.node = el("section", { id, class: "panel chart-panel", "aria-labelledby": `${id}-title` }, this.head, this.canvas, this.legend);
  }

  // `lines` are {name, points: [[wall ms, value or null]...]}; `from` and `to` wall-clock ms.
  draw(unit, lines, from, to, floor = null) {
    setText(this.head, `${this.title} (${unit})`);
    const made = pen(this.canvas);
    let low = Infinity, high = -Infinity;
    const told = lines.map(({ name, points }) => {
      const values = points.filter(([at, value]) => value !== null && at >= from).map((each) => each[1]);
      if (!values.length) return [name, null];
      const least = values.reduce((a, b) => Math.min(a, b)), most = values.reduce((a, b) => Math.max(a, b));
      low = Math.min(low, least); high = Math.max(high, most);
      return [name, [least, most, values[values.length - 1]]];
    });
    this.tell(unit, told);
    if (!made) return;
    const [draw, width, height, style] = made;
    const ink = style.getPropertyValue("--soft"), edge = style.getPropertyValue("--line");
    const right = width - RIGHT, bottom = height - BOTTOM;
    const x = (at) => LEFT + (right - LEFT) * (at - from) / (to - from);
    draw.fillStyle = ink; draw.strokeStyle = edge; draw.lineWidth = 1;
    draw.textAlign = "center"; draw.textBaseline = "alphabetic";
    for (const at of clockTicks(from, to, right - LEFT)) {
      draw.beginPath(); draw.moveTo(x(at), TOP); draw.lineTo(x(at), bottom); draw.stroke();
      if (x(at) > LEFT + 14 && x(at) < right - 14) draw.fillText(H.minute(at), x(at), height - 6);
    }
    if (low === Infinity) { draw.fillText(H.noValues, (LEFT + right) / 2, (TOP + bottom) / 2); return; }
    const [least, most, step] = niceRange(floor === null ? low : Math.min(floor, low), high);
    const y = (value) => bottom - (bottom - TOP) * (value - least) / (most - least);
    draw.textAlign = "right"; draw.textBaseline = "middle";
    for (let value = least; value <= most + step / 2; value += step) {
      draw.beginPath(); draw.moveTo(LEFT, y(value)); draw.lineTo(right, y(value)); draw.stroke();
      draw.fillText(short(value), LEFT - 6, y(value));
    }
    lines.forEach(({ points }, index) => {
      draw.strokeStyle = draw.fillStyle = style.getPropertyValue(`--plot-${index % 6}`);
      draw.lineWidth = 1.75;
      draw.setLineDash(index < 6 ? [] : index < 12 ? [6, 3] : [2, 3]);
      draw.beginPath();
      let begun = false;
      for (const [at, value] of points) {
        if (value === null || at < from) { begun = false; continue; }
        if (begun) draw.lineTo(x(at), y(value)); else { draw.moveTo(x(at), y(value)); draw.fillRect(x(at) - 1, y(value) - 1, 2, 2); }
        begun = true;
      }
      draw.stroke();
    });
    draw.setLineDash([]);
  }

  tell(unit, told) {
    const rows = told.map(([name, found]) => (found ? H.row(name, ...found.map(short)) : `${name}: ${H.noValues}`));
    setAttr(this.canvas, "aria-label", H.chart(this.title, unit, rows));
    const names = told.slice(0, LEGEND_MAX).map((each) => each[0]).join("\n");
    if (names !== this.names) {
      this.names = names;
      this.values = told.slice(0, LEGEND_MAX).map(() => el("b"));
      this.legend.replaceChildren(...told.slice(0, LEGEND_MAX).map(([name], index) =>
        el("li", {}, el("span", { class: "line-key", "data-color": index % 6, "data-dash": Math.floor(index / 6) }), `${name} `, this.values[index])));
    }
    told.slice(0, LEGEND_MAX).forEach(([, found], index) => setText(this.values[index], found ? short(found[2]) : "\u2013"));
  }
}
