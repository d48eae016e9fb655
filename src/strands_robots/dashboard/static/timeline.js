// Events and audit records: a log of a fixed height. What comes is added below, and nobody who reads above is moved.
import { el, setText } from "./dom.js";
import { eventText, factsText } from "./events.js";
import { S } from "./strings.js";

const SHOWN_MAX = 200, READ_MAX = 1000;
const NEAR_PX = 24;

export class Timeline {
  constructor(fleet) {
    this.fleet = fleet;
    this.filter = el("input", { id: "timeline-filter", type: "search", autocomplete: "off", spellcheck: "false" });
    this.which = el("select", { id: "timeline-which", "aria-label": S.timelineFilter });
    for (const [value, text] of Object.entries(S.withAudit)) this.which.append(el("option", { value, text }));
    this.list = el("ol", { class: "events", tabindex: 0, "aria-label": S.timeline });
    this.none = el("p", { class: "small none" });
    this.node = el("section", { class: "panel timeline", "aria-labelledby": "timeline-title" }, el("h3", { id: "timeline-title", text: S.timeline }),
      el("div", { class: "tools" }, el("label", { for: "timeline-filter", text: S.timelineFilter }), this.filter, this.which), el("div", { class: "log" }, this.none, this.list));
    for (const control of [this.filter, this.which]) control.addEventListener("input", () => this.draw(this.robot, true));
  }

  wanted(each) {
    const text = this.filter.value.trim().toLowerCase(), row = this.fleet.rows.get(this.robot);
    return (!row || each.key === this.robot || (each.audit && each.robot === row.id) || each.robot === "") &&
      (this.which.value === "all" || (this.which.value === "audit") === each.audit) &&
      (!text || `${each.event} ${eventText(each.event)} ${each.robot} ${JSON.stringify(each.facts)}`.toLowerCase().includes(text));
  }

  draw(robot, anew = false) {
    const events = this.fleet.events, last = events.length ? events[events.length - 1].n : 0;
    anew = anew || robot !== this.robot || last < this.last;
    if (!anew && last === this.last) return;
    const since = anew ? 0 : this.last;
    this.last = last;
    this.robot = robot;
    const below = anew || this.list.scrollHeight - this.list.scrollTop - this.list.clientHeight < NEAR_PX;
    const lines = events.filter((each) => each.n > since && this.wanted(each)).slice(-SHOWN_MAX).map((each) =>
      el("li", { "data-audit": each.audit ? "yes" : "no" }, el("time", { datetime: new Date(each.at * 1000).toISOString(), text: S.when(new Date(each.at * 1000)) }), " ",
        el("strong", { text: eventText(each.event), title: each.event }), ` ${each.robot} `, el("small", { text: factsText(each) })));
    if (anew) this.list.replaceChildren(...lines); else this.list.append(...lines);
    // While somebody reads above, more of the oldest stay as well.
    while (this.list.childElementCount > (below ? SHOWN_MAX : READ_MAX)) this.list.firstChild.remove();
    if (below) this.list.scrollTop = this.list.scrollHeight;
    setText(this.none, this.list.childElementCount ? "" : S.nothing);
  }
}
