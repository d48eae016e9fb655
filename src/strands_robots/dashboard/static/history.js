// The fleet over time: a lane for each robot, charts of the chosen one, and files of both.
import { Chart } from "./chart.js";
import { el, own, setAttr, setText } from "./dom.js";
import { bothJson, chartsCsv, save, statesCsv } from "./export.js";
import { Filter } from "./filter.js";
import { byName, kindText, nameText } from "./fleet.js";
import { H } from "./history-strings.js";
import { clipped, drawAxis, Lane } from "./lanes.js";

const ASK_MS = 2000, KEPT_S = 3600, CHARTS_S = 900;
// As many changes of a robot as the server keeps.
const CHANGES_MAX = 1000;
const TURN = 180 / Math.PI;

async function* answerLines(address) {
  const answer = await fetch(address, { signal: AbortSignal.timeout(10_000) });
  if (!answer.ok) throw new Error(String(answer.status));
  const reader = answer.body.getReader(), decoder = new TextDecoder();
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    rest += decoder.decode(value, { stream: !done });
    const whole = rest.split("\n");
    rest = whole.pop();
    for (const line of whole) if (line) yield JSON.parse(line);
    if (done) return;
  }
}

export class HistoryView {
  constructor(fleet, state) {
    this.fleet = fleet;
    this.state = state;
    this.lanes = new Map();
    this.visible = new Set();
    this.order = [];
    this.seconds = 300;
    this.filter = new Filter(fleet, kindText, () => { this.order = []; this.draw(); }, "history-");
    this.window = el("div", { class: "choices", role: "group", "aria-label": H.window });
    for (const [value, text] of Object.entries(H.windows)) {
      const button = el("button", { type: "button", "data-seconds": value, "aria-pressed": String(Number(value) === this.seconds), text });
      button.addEventListener("click", () => this.setWindow(Number(value)));
      this.window.append(button);
    }
    this.axis = el("canvas", { class: "axis", "aria-hidden": "true" });
    this.list = el("ul", { class: "lanes", tabindex: 0, "aria-label": H.lanes });
    this.empty = el("p", { class: "lanes-empty", role: "status" });
    const legend = el("ul", { class: "chart-legend states", "aria-label": H.legend }, ...Object.entries(H.states).map(([state, text]) => el("li", {}, el("span", { class: "state-key", "data-state": state }), text)));
    this.said = el("p", { class: "history-said", role: "status" });
    this.files = el("div", { class: "choices", role: "group", "aria-label": H.exportLabel });
    for (const [what, text] of [["states", H.statesCsv], ["charts", H.chartsCsv], ["json", H.bothJson]]) {
      const button = el("button", { type: "button", "data-file": what, disabled: what === "charts", text });
      button.addEventListener("click", () => this.save(what));
      this.files.append(button);
    }
    this.chartsTitle = el("h3", { id: "charts-title", text: H.charts("") });
    this.note = el("p", { class: "small", text: H.kept(CHARTS_S / 60) });
    this.loadNote = el("p", { class: "small load-note" });
    this.joints = new Chart("chart-joints", H.joints);
    this.others = new Chart("chart-others", H.others);
    this.lag = new Chart("chart-lag", H.lag);
    this.load = new Chart("chart-load", H.load);
    this.node = el("div", { id: "history" }, el("div", { class: "history-head" }, el("h2", { text: H.title }), this.window, el("span", { class: "small", text: H.exportLabel }), this.files),
      this.filter.node, legend,
      el("div", { class: "panel lanes-panel" }, el("div", { class: "axis-row" }, this.axis), this.list, this.empty), this.said,
      el("section", { "aria-labelledby": "charts-title" }, el("div", { class: "charts-head" }, this.chartsTitle, this.note, this.loadNote),
        el("div", { class: "charts" }, this.joints.node, this.others.node, this.lag.node, this.load.node)));
    this.observer = new IntersectionObserver((entries) => {
      for (const entry of entries) {
        const lane = this.lanes.get(entry.target.dataset.key);
        if (entry.isIntersecting) this.visible.add(entry.target.dataset.key);
        else { this.visible.delete(entry.target.dataset.key); if (lane) lane.canvas.width = 0; }
      }
      this.drawLanes();
    }, { root: this.list, rootMargin: "60px" });
    this.reset();
    setInterval(() => this.ask(), ASK_MS);
    setInterval(() => { if (this.shown) this.draw(); }, 1000);
  }

  get shown() { return this.node.isConnected && !document.hidden; }

  // After a new connection: another server has another clock.
  reset() {
    this.tracks = new Map();
    this.number = 0;
    this.at = 0;
    this.clock = null;
    // Of the page's server: the timeline has what robots say, too, and less of the past.
    this.stops = [];
    this.series = null;
  }

  open() {
    this.filter.open();
    this.order = [];
    this.ask();
    this.draw();
  }

  setWindow(seconds) {
    this.seconds = seconds;
    for (const button of this.window.children) setAttr(button, "aria-pressed", Number(button.dataset.seconds) === seconds);
    this.draw();
  }

  choose(key) {
    this.key = key;
    this.series = null;
    for (const lane of this.lanes.values()) setAttr(lane.button, "aria-pressed", lane.key === key);
    // Units and limits are read from a robot that somebody looks at.
    if (this.looked !== key) { this.looked = key; this.state.ask({ type: "look", key }); }
    this.ask(true);
    this.draw();
  }

  async ask(again = false) {
    if (!this.shown || !this.ticket) return;
    if (this.asking) { this.again = this.again || again; return; }
    this.asking = true;
    try {
      await this.askStates();
      if (this.key) await this.askSeries(this.key);
      setText(this.said, "");
    } catch {
      setText(this.said, H.noData);
    }
    this.asking = false;
    if (this.again) { this.again = false; this.ask(); } else this.draw();
  }

  async askStates() {
    const tracks = this.tracks;
    let head = null;
    for await (const line of answerLines(`history?${new URLSearchParams({ ticket: this.ticket, number: this.number, at: this.at })}`)) {
      if (tracks !== this.tracks) return;
      if (!head) { head = line; continue; }
      const old = tracks.get(line.key) || { at: [], as: "" };
      const keep = old.at.filter((each) => each < line.at[0]).length;
      let track = { at: old.at.slice(0, keep).concat(line.at), as: old.as.slice(0, keep) + line.as };
      const drop = Math.max(track.at.filter((each) => each < head.now - KEPT_S).length - 1, track.at.length - CHANGES_MAX);
      if (drop > 0) track = { at: track.at.slice(drop), as: track.as.slice(drop) };
      tracks.set(line.key, track);
    }
    if (!head) return;
    this.number = head.number;
    this.at = head.now;
    this.stops = head.stops;
    this.clock = { now: head.now, wall: head.wall, here: performance.now() };
  }

  async askSeries(key) {
    const old = this.series && this.series.key === key ? this.series : { key, times: [], units: {}, values: {} };
    const after = old.times.length ? old.times[old.times.length - 1] : 0;
    let head = null;
    const values = {};
    try {
      for await (const line of answerLines(`series?${new URLSearchParams({ ticket: this.ticket, robot: key, after })}`)) {
        if (!head) head = line; else values[line.name] = line.values;
      }
    } catch (problem) {
      if (problem.message !== "404") throw problem;
    }
    if (!head || key !== this.key) return;
    const times = old.times.concat(head.times), drop = Math.max(0, times.length - 450);
    const joined = {};
    for (const [name, fresh] of Object.entries(values)) joined[name] = (old.values[name] || old.times.map(() => null)).concat(fresh).slice(drop);
    this.series = { key, times: times.slice(drop), units: head.units, values: joined };
  }

  now() { return this.clock ? this.clock.now + (performance.now() - this.clock.here) / 1000 : 0; }

  rows() { return [...this.fleet.rows.values()].filter((row) => this.filter.passes(row)); }

  draw() {
    if (!this.shown) return;
    const rows = this.rows(), passing = new Set(rows.map((row) => row.key));
    this.arrange(rows, passing);
    this.filter.tell(rows.length);
    setText(this.empty, rows.length ? "" : this.fleet.rows.size ? H.noMatch : H.none);
    if (!this.key && rows.length) this.choose(this.order.find((key) => passing.has(key)));
    this.drawLanes();
    this.drawCharts();
  }

  // Rows keep their places while the view is open and the filter is the same: one that comes stands last, and one that
  // passes no more is only not seen.
  arrange(rows, passing) {
    const known = new Set(this.order);
    const fresh = rows.filter((row) => !known.has(row.key)).sort((a, b) => byName.compare(a.id, b.id));
    if (fresh.length || this.list.childElementCount !== this.order.length) this.place(fresh);
    for (const key of this.order) setAttr(this.lanes.get(key).node, "data-passes", passing.has(key) ? "yes" : "no");
  }

  place(fresh) {
    const order = this.order.concat(fresh.map((row) => row.key)), wanted = new Map(fresh.map((row) => [row.key, row])), kept = new Set(order);
    this.order = order;
    for (const key of [...this.lanes.keys()]) if (!kept.has(key) && !this.fleet.rows.has(key)) this.lanes.delete(key);
    this.observer.disconnect();
    this.visible.clear();
    this.list.replaceChildren(...order.map((key) => {
      if (!this.lanes.has(key)) {
        const lane = new Lane(wanted.get(key), (chosen) => this.choose(chosen));
        setAttr(lane.button, "aria-pressed", key === this.key);
        this.lanes.set(key, lane);
      }
      return this.lanes.get(key).node;
    }));
    for (const node of this.list.children) this.observer.observe(node);
  }

  drawLanes() {
    if (!this.clock || !this.shown) return;
    const to = this.now(), from = to - this.seconds, offset = this.clock.wall - this.clock.now;
    drawAxis(this.axis, from, to, offset, this.stops.filter(([event]) => event === "STOP pressed").map(([, at]) => at * 1000));
    for (const key of this.visible) {
      const row = this.fleet.rows.get(key);
      if (!row) continue;
      this.lanes.get(key).name(nameText(row));
      this.lanes.get(key).draw(this.tracks.get(key), from, to, offset, this.fleet.attention(row) === 0, this.stops.filter(([event, , halted]) => event === "halted here" && halted === key).map(([, at]) => at));
    }
  }

  // The series of the chosen robot in the units of the charts: degrees, milliseconds, messages or percent.
  columns() {
    const { values, units } = this.series || { values: {}, units: {} };
    const found = { joints: [], others: [], lag: [], load: [] };
    const parts = new Set(Object.keys(values).filter((name) => name.startsWith("joint:")).map((name) => name.slice(6, name.indexOf("/"))));
    for (const [name, given] of Object.entries(values)) {
      const joint = name.startsWith("joint:") ? name.slice(name.indexOf("/") + 1) : "";
      if (joint) {
        const shown = parts.size > 1 ? `${name.slice(6, name.indexOf("/"))} ${joint}` : joint, unit = own(units, joint) || "";
        const angle = unit === "radians" || unit === "degrees";
        found[angle ? "joints" : "others"].push({ name: shown, unit: angle ? H.degrees : unit || H.notStated,
          values: unit === "radians" ? given.map((each) => (each === null ? null : Number((each * TURN).toFixed(3)))) : given });
      } else if (name === "lag" || name === "answer") found.lag.push({ name: H.names[name], unit: H.ms, values: given });
      else if (name === "load" && given.some((each) => each !== null)) found.load.push({ name: H.names.load, unit: H.percent, values: given.map((each) => (each === null ? null : each * 100)) });
      else if (name === "rate") found.rate = { name: H.names.rate, unit: H.perSecond, values: given };
    }
    this.loadStated = found.load.length > 0;
    if (!this.loadStated && found.rate) found.load.push(found.rate);
    return found;
  }

  drawCharts() {
    const row = this.key && this.fleet.rows.get(this.key);
    setText(this.chartsTitle, H.charts(row ? nameText(row) : ""));
    const found = this.columns();
    this.files.querySelector("[data-file=charts]").disabled = !(row && this.series);
    setText(this.loadNote, this.series ? this.loadStated ? H.loadKnown : H.loadUnknown : "");
    if (!this.clock) return;
    const offset = this.clock.wall - this.clock.now, to = (this.now() + offset) * 1000;
    const from = to - Math.min(this.seconds, CHARTS_S) * 1000, times = (this.series ? this.series.times : []).map((at) => (at + offset) * 1000);
    const lines = (columns, unit) => columns.map((each) => ({ name: unit ? `${each.name} (${each.unit})` : each.name, points: times.map((at, index) => [at, each.values[index]]) }));
    const units = [...new Set(found.others.map((each) => each.unit))];
    this.joints.draw(H.degrees, lines(found.joints), from, to);
    this.others.draw(units.join(", ") || "\u2013", lines(found.others, units.length > 1), from, to);
    this.lag.draw(H.ms, lines(found.lag), from, to, 0);
    this.load.draw(this.loadStated ? H.percent : H.perSecond, lines(found.load), from, to, 0);
  }

  save(what) {
    if (!this.clock) return;
    const to = this.now(), from = to - this.seconds, offset = this.clock.wall - this.clock.now;
    const states = this.order.map((key) => [this.fleet.rows.get(key), this.tracks.get(key)]).filter(([row, track]) => row && track && this.filter.passes(row))
      .map(([row, track]) => ({ row, intervals: clipped(track, from, to).map(([state, begin, end]) => [state, begin + offset, end + offset]) }));
    let series = null;
    const row = this.key && this.fleet.rows.get(this.key);
    if (row && this.series) {
      const found = this.columns(), first = this.series.times.filter((at) => at < from).length;
      const columns = [...found.joints, ...found.others, ...found.lag, ...found.load].map((each) => ({ ...each, values: each.values.slice(first) }));
      series = { id: row.id, times: this.series.times.slice(first).map((at) => at + offset), columns };
    }
    const stamp = new Date((to + offset) * 1000).toISOString().slice(0, 19).replaceAll(":", "");
    if (what === "states") save(`states-${stamp}.csv`, "text/csv", statesCsv(states));
    else if (what === "charts" && series) save(`charts-${stamp}.csv`, "text/csv", chartsCsv(series));
    else if (what === "json") save(`history-${stamp}.json`, "application/json", bothJson(states, series, this.seconds));
  }
}
