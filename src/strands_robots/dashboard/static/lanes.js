// A row for each robot, with coloured and labelled intervals of its states.
import { clockTicks, pen } from "./chart.js";
import { el, setAttr, setText } from "./dom.js";
import { H } from "./history-strings.js";

// Later ones are drawn over earlier ones, so that a short lockout is never hidden by a long motion.
const ORDER = "sqmlx";
const COLOR = { m: "--link", s: "--soft", l: "--warn", x: "--stop", q: "--ink" };
const PAPER = { m: "--link", s: "--chip", l: "--warn-paper", x: "--stop", q: "--paper" };
const LABEL = { m: "--on-link", s: "--soft", l: "--warn", x: "--stop-ink", q: "--ink" };

export function clipped(track, from, to) {
  const found = [];
  for (let index = 0; index < track.at.length; index += 1) {
    const begin = Math.max(from, track.at[index]), end = Math.min(to, index + 1 < track.at.length ? track.at[index + 1] : to);
    if (end > begin) found.push([track.as[index], begin, end]);
  }
  return found;
}

export function lasting(seconds) {
  const whole = Math.round(seconds);
  return whole < 60 ? `${whole}\u00a0s` : `${Math.floor(whole / 60)}\u00a0min ${whole % 60}\u00a0s`;
}

export function summary(intervals) {
  const sums = {};
  for (const [state, begin, end] of intervals) sums[state] = (sums[state] || 0) + end - begin;
  return ORDER.split("").reverse().filter((state) => sums[state]).map((state) => `${H.states[state]} ${lasting(sums[state])}`).join(", ") || H.unknown;
}

export class Lane {
  constructor(row, onChoose) {
    this.key = row.key;
    this.button = el("button", { type: "button", class: "lane-name", "aria-pressed": "false", title: H.choose(row.id), text: row.id });
    this.button.addEventListener("click", () => onChoose(row.key));
    this.now = el("span", { class: "lane-now" });
    this.canvas = el("canvas", { class: "lane-canvas", role: "img", "aria-label": row.id });
    this.node = el("li", { class: "lane", "data-key": row.key }, this.button, this.now, this.canvas);
    this.id = row.id;
  }

  name(text) {
    this.id = text;
    setText(this.button, text);
  }

  // Times are seconds of the server's clock.
  draw(track, from, to, wallOffset, red, halts) {
    const last = track && track.as.length ? track.as[track.as.length - 1] : "";
    setText(this.now, H.states[last] || H.unknown);
    setAttr(this.now, "data-state", last);
    setAttr(this.node, "data-red", red ? "yes" : "no");
    const intervals = track ? clipped(track, from, to) : [];
    setAttr(this.canvas, "aria-label", H.lane(this.id, summary(intervals) + H.halts(halts.filter((at) => at - wallOffset > from).length)));
    const made = pen(this.canvas);
    if (!made) return;
    const [draw, width, height, style] = made;
    const x = (at) => width * (at - from) / (to - from);
    draw.strokeStyle = style.getPropertyValue("--line");
    for (const at of clockTicks((from + wallOffset) * 1000, (to + wallOffset) * 1000, width)) {
      const place = x(at / 1000 - wallOffset);
      draw.beginPath(); draw.moveTo(place, 0); draw.lineTo(place, height); draw.stroke();
    }
    draw.textBaseline = "middle";
    for (const state of ORDER) for (const [each, begin, end] of intervals) if (each === state) this.block(draw, style, state, x(begin), Math.max(2, x(end) - x(begin)), height);
    draw.font = "bold 11px system-ui, sans-serif";
    for (const place of halts.map((at) => x(at - wallOffset)).filter((each) => each >= 0)) {
      const wide = draw.measureText(H.haltMark).width + 6, left = place > width - wide ? place - wide : place;
      draw.fillStyle = style.getPropertyValue("--ink");
      draw.fillRect(place - 1, 0, 2, height);
      draw.fillRect(left, 0, wide, 14);
      draw.fillStyle = style.getPropertyValue("--card");
      draw.fillText(H.haltMark, left + 3, 7.5);
    }
  }

  block(draw, style, state, left, width, height) {
    // A state has a height and a pattern of its own, too.
    const top = state === "s" ? height * 0.22 : state === "q" ? height * 0.2 : 3, tall = height - 2 * top;
    draw.save();
    draw.beginPath(); draw.rect(left, top, width, tall); draw.clip();
    draw.fillStyle = style.getPropertyValue(PAPER[state]);
    draw.fillRect(left, top, width, tall);
    draw.strokeStyle = style.getPropertyValue(COLOR[state]);
    if (state === "l" || state === "x") {
      draw.strokeStyle = style.getPropertyValue(state === "x" ? "--stop-ink" : "--warn");
      draw.globalAlpha = 0.35;
      draw.beginPath();
      for (let at = left - tall - (left % 8); at < left + width; at += 8) { draw.moveTo(at, top + tall); draw.lineTo(at + tall, top); }
      draw.stroke();
      draw.globalAlpha = 1;
    }
    if (state === "q") draw.setLineDash([3, 3]);
    draw.strokeStyle = style.getPropertyValue(COLOR[state]);
    draw.strokeRect(left + 0.5, top + 0.5, Math.max(1, width - 1), tall - 1);
    const text = H.states[state], letter = H.letters[state], size = draw.measureText(text).width;
    const label = width > size + 10 ? text : width > 13 ? letter : "";
    if (label) {
      const wide = draw.measureText(label).width;
      if (state !== "m" && state !== "x") { draw.fillStyle = style.getPropertyValue(PAPER[state]); draw.fillRect(left + 3, top + 2, wide + 4, tall - 4); }
      draw.fillStyle = style.getPropertyValue(LABEL[state]);
      draw.fillText(label, left + 5, height / 2 + 0.5);
    }
    draw.restore();
  }
}

// Clock times above the lanes, with a mark for each press of STOP.
export function drawAxis(canvas, from, to, wallOffset, stops) {
  const made = pen(canvas);
  if (!made) return;
  const [draw, width, height, style] = made;
  const x = (at) => width * (at / 1000 - wallOffset - from) / (to - from);
  draw.fillStyle = style.getPropertyValue("--soft");
  draw.textAlign = "center";
  for (const at of clockTicks((from + wallOffset) * 1000, (to + wallOffset) * 1000, width)) {
    if (x(at) > 18 && x(at) < width - 18) draw.fillText(H.minute(at), x(at), 12);
  }
  draw.fillStyle = style.getPropertyValue("--bad");
  draw.font = "bold 11px system-ui, sans-serif";
  for (const at of stops) {
    if (x(at) < 0) continue;
    draw.fillRect(x(at) - 1, 15, 2, height - 15);
    draw.textAlign = x(at) > width - 40 ? "right" : "left";
    draw.fillText(H.stopMark, x(at) + (x(at) > width - 40 ? -4 : 4), height - 3);
  }
}
