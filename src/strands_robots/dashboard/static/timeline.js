// Events and audit records, newest first.
import { el } from "./dom.js";
import { S } from "./strings.js";

const SHOWN_MAX = 100;
const EMPTY = ["", "[]", "{}", null];

export class Timeline {
  constructor(fleet) {
    this.fleet = fleet;
    this.filter = el("input", { id: "timeline-filter", type: "search", autocomplete: "off", spellcheck: "false" });
    this.which = el("select", { id: "timeline-which", "aria-label": S.timelineFilter });
    for (const [value, text] of Object.entries(S.withAudit)) this.which.append(el("option", { value, text }));
    this.list = el("ol", { class: "events" });
    this.node = el("section", { class: "panel", "aria-labelledby": "timeline-title" }, el("h3", { id: "timeline-title", text: S.timeline }),
      el("div", { class: "tools" }, el("label", { for: "timeline-filter", text: S.timelineFilter }), this.filter, this.which), this.list);
    for (const control of [this.filter, this.which]) control.addEventListener("input", () => this.draw(this.robot, true));
  }

  draw(robot, force = false) {
    const last = this.fleet.events.length ? this.fleet.events[this.fleet.events.length - 1].n : 0;
    const row = this.fleet.rows.get(robot);
    if (!force && last === this.last && robot === this.robot) return;
    this.last = last;
    this.robot = robot;
    const wanted = this.filter.value.trim().toLowerCase();
    const shown = this.fleet.events.filter((each) =>
      (!row || each.key === robot || each.robot === row.id || each.robot === "") &&
      (this.which.value === "all" || (this.which.value === "audit") === each.audit) &&
      (!wanted || `${each.event} ${each.robot} ${JSON.stringify(each.facts)}`.toLowerCase().includes(wanted)))
      .slice(-SHOWN_MAX).reverse();
    this.list.replaceChildren(...shown.map((each) => el("li", { "data-audit": each.audit ? "yes" : "no" },
      el("time", { text: S.when(new Date(each.at * 1000)) }), " ", el("strong", { text: each.event }), ` ${each.robot} `,
      el("small", { text: Object.entries(each.facts).filter(([, value]) => !EMPTY.includes(value)).map(([name, value]) => `${name}: ${value}`).join(" · ") }))));
    if (!shown.length) this.list.append(el("li", { text: S.nothing }));
  }
}
