// The joints of a robot: a bar each, and the last 30 seconds with axes and a legend.
import { el, setAttr, setText } from "./dom.js";
import { Plot, PLOTTED_MAX } from "./plot.js";
import { S } from "./strings.js";
import { limitsOf, shownIn, unitOf } from "./units.js";

export class Joints {
  constructor() {
    this.bars = new Map();
    this.list = el("div", { class: "bars", tabindex: 0, role: "group", "aria-label": S.joints });
    this.legend = el("ul", { class: "legend", tabindex: 0, "aria-label": S.legend });
    const canvas = el("canvas", { class: "plot", role: "img", "aria-label": S.plot });
    this.plot = new Plot(canvas);
    this.node = el("section", { class: "panel joints", "aria-labelledby": "joints-title" }, el("h3", { id: "joints-title", text: S.joints }), this.list,
      el("h3", { text: S.plot }), canvas, this.legend);
  }

  open() {
    this.bars.clear();
    this.keys = "";
    this.limits = this.units = null;
    this.list.replaceChildren(el("p", { class: "small", text: S.noJoints }));
    this.legend.replaceChildren();
    this.plot.reset([]);
  }

  details(detail) {
    this.plot.limits = this.limits = detail.limits;
    this.plot.units = this.units = detail.units;
    this.plot.reset(detail.history);
    this.keys = "";
    if (detail.history.length) this.show(detail.history[detail.history.length - 1][1]);
  }

  take(detail) {
    this.plot.add(detail.at, detail.joints);
    this.show(detail.joints);
  }

  show(joints) {
    const names = [];
    for (const [part, own] of Object.entries(joints)) for (const [name, value] of Object.entries(own)) names.push([part, name, value]);
    const keys = names.map(([part, name]) => `${part}/${name}`).join("\n");
    if (keys !== this.keys) { this.keys = keys; this.makeBars(names); }
    for (const [part, name, value] of names) this.bars.get(`${part}/${name}`).show(value, limitsOf(this.limits, this.units, name), unitOf(this.units, name));
  }

  makeBars(names) {
    this.bars.clear();
    const parts = new Set(names.map((each) => each[0]));
    const label = (part, name) => (parts.size > 1 ? `${part} ${name}` : name).replace(/\.pos$/, "");
    const nodes = names.map(([part, name], index) => {
      const bar = new Bar(label(part, name), index);
      this.bars.set(`${part}/${name}`, bar);
      return bar.node;
    });
    this.list.replaceChildren(...nodes);
    this.legend.replaceChildren(...names.slice(0, PLOTTED_MAX).map(([part, name], index) =>
      el("li", {}, el("span", { class: "swatch", "data-color": index % 6, "data-dashed": index < 6 ? "no" : "yes" }), label(part, name))));
  }
}

class Bar {
  constructor(name, index) {
    this.mark = el("span", { class: "mark", "data-color": index % 6 });
    this.value = el("span", { class: "value" });
    this.low = el("span", { class: "end" });
    this.high = el("span", { class: "end" });
    this.meter = el("div", { class: "track", role: "meter", "aria-label": name }, this.mark);
    this.node = el("div", { class: "bar" }, el("span", { class: "joint", text: name, title: name }), this.low, this.meter, this.high, this.value);
  }

  show(value, [low, high], unit) {
    const share = Math.min(1, Math.max(0, (value - low) / (high - low)));
    this.mark.style.left = `${(share * 100).toFixed(2)}%`;
    setText(this.value, shownIn(unit, value));
    setText(this.low, (low * unit.factor).toFixed(unit.digits ? unit.digits - 1 : 0));
    setText(this.high, (high * unit.factor).toFixed(unit.digits ? unit.digits - 1 : 0));
    for (const [name, number] of [["aria-valuenow", value], ["aria-valuemin", Math.min(low, value)], ["aria-valuemax", Math.max(high, value)]]) setAttr(this.meter, name, (number * unit.factor).toFixed(3));
    setAttr(this.meter, "aria-valuetext", shownIn(unit, value));
    this.meter.dataset.edge = share < 0.02 || share > 0.98 ? "yes" : "no";
  }
}
