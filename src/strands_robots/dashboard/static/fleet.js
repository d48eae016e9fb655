// The rows of all robots, and their cards sorted by what needs attention.
import { el, setAttr, setText } from "./dom.js";
import { Filter } from "./filter.js";
import { S } from "./strings.js";

// Made once: a comparison that makes its own collator costs a hundred times as much.
export const byName = new Intl.Collator("en", { numeric: true });
const STALE_S = 3;
const BAD = ["not_stopped", "alarm", "unknown", "refused", "silent"];

export class Fleet {
  constructor() {
    this.rows = new Map();
    this.mine = new Set();
    this.events = [];
    this.now = 0;
    this.nowAt = 0;
    this.version = 0;
  }

  take(message) {
    this.now = message.now;
    this.nowAt = performance.now();
    for (const row of message.rows) this.rows.set(row.key, row);
    for (const key of message.gone) this.rows.delete(key);
    if (message.events.length) this.events = this.events.concat(message.events).slice(-1000);
    this.version += 1;
  }

  // The age grows also while nothing arrives.
  age(row) {
    if (row.heard === null) return null;
    return Math.max(0, this.now + (performance.now() - this.nowAt) / 1000 - row.heard);
  }

  moving(row) { return ["running", "stopping", "starting", "connecting"].includes(row.task.state); }

  stale(row) { const age = this.age(row); return age === null || age > STALE_S; }

  // 0 is the worst.
  attention(row) {
    if ((row.stop && (BAD.includes(row.stop.state) || row.stop.alarm)) || row.alarm) return 0;
    if (row.stop && row.stop.state === "claimed" && !row.stop.freed) return 1;
    if (row.stop && row.stop.state === "waiting") return 1;
    if (row.doubt || row.locked === null) return 2;
    if (this.stale(row)) return 3;
    if (row.locked) return 4;
    return this.moving(row) ? 5 : 6;
  }

  sorted(filter) {
    return [...this.rows.values()].filter((row) => filter.passes(row))
      .map((row) => [this.attention(row), row])
      .sort((a, b) => a[0] - b[0] || byName.compare(a[1].id, b[1].id))
      .map((pair) => pair[1]);
  }
}

export function verdictText(stop) {
  let text = S.verdict[stop.state] || S.verdict.unknown;
  if (stop.settling) text += S.settling;
  if (stop.ms !== null && stop.ms !== undefined && ["stopped", "claimed"].includes(stop.state)) text += S.inMs(stop.ms);
  if (stop.state === "stopped") text += ` (${stop.signed ? S.signed : S.unsigned})`;
  if (stop.state === "claimed") text += S.unproven;
  if (stop.why) text += `: ${stop.why}`;
  if (stop.alarm) text += `. ALARM: ${stop.alarm}`;
  if (stop.freed) text += S.freed;
  return text;
}

export function verdictTone(stop) {
  if (stop.alarm) return "bad";
  // It says nothing about the present any more, so it is not green.
  if (stop.freed && ["stopped", "claimed"].includes(stop.state)) return "quiet";
  return { stopped: "good", claimed: "warn", waiting: "warn", heard_only: "quiet" }[stop.state] || "bad";
}

export function lockText(row) {
  if (row.locked === null) return `${S.lockUnknown}${row.doubt ? `: ${row.doubt}` : ""}`;
  if (!row.locked) return S.free;
  const first = row.lockouts[0];
  if (!first) return S.locked;
  const at = typeof first.since === "number" ? S.when(new Date(first.since * 1000)) : "";
  const why = `${first.scope ? ` (${first.scope})` : ""}${first.reason ? `: ${first.reason}` : ""}`;
  return `${S.lockedBy(first.source, at)}${why}${row.lockouts.length > 1 ? ` (×${row.lockouts.length})` : ""}`;
}

export function kindText(row) {
  return [row.model, S.kinds[row.kind] || row.kind, S.network[row.network] || row.network].filter(Boolean).join(" · ");
}

export function taskText(row) {
  const task = row.task;
  if (!task.state || task.state === "idle") return S.idle;
  const step = typeof task.step === "number" && ["running"].includes(task.state) ? `, ${S.step(task.step)}` : "";
  return `${task.state}${task.instruction ? `: ${task.instruction}` : ""}${step}`;
}

export function ageText(fleet, row) {
  const age = fleet.age(row);
  if (age === null) return S.neverHeard;
  const link = row.link_ms === null ? "" : ` · ${S.roundTrip(row.link_ms)}`;
  return `${age < 1 ? S.heardNow : S.heard(Math.floor(age))}${link}`;
}

export function controlText(fleet, row) {
  if (fleet.mine.has(row.key)) return S.heldHere;
  return row.control.held ? S.heldBy(row.control.holder, row.control.kind) : S.notHeld;
}

class Card {
  constructor(row, onStop) {
    this.key = row.key;
    const href = `#/robot/${encodeURIComponent(row.key)}`;
    this.picture = el("img", { class: "thumb", alt: "" });
    // A second link to the same place, for a pointer.
    this.shot = el("a", { class: "shot", href, tabindex: -1, "aria-hidden": "true", hidden: true }, this.picture);
    this.name = el("a", { class: "name", href });
    this.kind = el("span", { class: "kind" });
    this.task = el("p", { class: "task" });
    this.lock = el("p", { class: "lock" });
    this.verdict = el("p", { class: "verdict" });
    this.control = el("span");
    this.check = el("span", { class: "check" });
    this.age = el("span", { class: "age" });
    this.stop = el("button", { type: "button", class: "stop-one", title: S.stopOne(row.id), "aria-label": S.stopOne(row.id), text: S.stopOneShort });
    this.stop.addEventListener("click", () => onStop(row.id));
    this.node = el("li", { class: "card", "data-key": row.key }, this.shot,
      el("div", { class: "body" },
        el("div", { class: "head" }, el("div", { class: "who" }, this.name, this.kind), this.stop),
        el("div", { class: "now" }, this.task, this.lock), this.verdict,
        el("p", { class: "small" }, this.control, this.check, this.age)));
  }

  show(fleet, row) {
    setText(this.name, row.id);
    setText(this.kind, kindText(row));
    setText(this.task, taskText(row));
    setAttr(this.task, "data-on", fleet.moving(row) ? "yes" : "no");
    this.shot.hidden = !row.pictures;
    setAttr(this.node, "data-attention", fleet.attention(row));
    setText(this.lock, lockText(row));
    setAttr(this.lock, "data-tone", row.alarm ? "bad" : row.locked === false ? "quiet" : "warn");
    setText(this.verdict, row.stop ? `${S.lastStop}: ${verdictText(row.stop)}` : "");
    setAttr(this.verdict, "data-tone", row.stop ? verdictTone(row.stop) : "quiet");
    setText(this.control, controlText(fleet, row));
    setText(this.check, row.check_in ? S.checkIn(row.check_in.left_s) : "");
    this.tick(fleet, row);
  }

  tick(fleet, row) {
    setText(this.age, ageText(fleet, row));
    setAttr(this.age, "data-tone", fleet.stale(row) ? "bad" : "quiet");
  }
}

export class FleetView {
  constructor(fleet, state, onStop) {
    this.fleet = fleet;
    this.state = state;
    this.onStop = onStop;
    this.cards = new Map();
    this.visible = new Set();
    this.drawn = new Map();
    this.starting = [];
    this.filter = new Filter(fleet, kindText, () => { this.order = ""; this.draw(); });
    this.list = el("ul", { id: "cards" });
    this.coming = el("ul", { id: "coming", "aria-label": S.coming });
    this.empty = el("p", { class: "empty" });
    this.node = el("div", { id: "fleet" },
      this.filter.node, this.empty, this.list, this.coming);
    this.observer = new IntersectionObserver((entries) => {
      for (const entry of entries) {
        const key = entry.target.dataset.key;
        if (entry.isIntersecting) this.visible.add(key); else this.visible.delete(key);
      }
      this.askThumbnails();
    }, { rootMargin: "100px" });
  }

  draw() {
    const rows = this.fleet.sorted(this.filter);
    this.filter.tell(rows.length);
    this.drawComing();
    setText(this.empty, !this.admitted || this.coming.childElementCount ? "" : this.fleet.rows.size === 0 ? S.none : rows.length === 0 ? S.noMatch : "");
    this.empty.hidden = this.empty.textContent === "";
    for (const row of rows) {
      let card = this.cards.get(row.key);
      if (!card) {
        card = new Card(row, this.onStop);
        this.cards.set(row.key, card);
      }
      if (this.drawn.get(row.key) !== row || this.mineVersion !== this.fleet.mine.size) { card.show(this.fleet, row); this.drawn.set(row.key, row); }
      else if (this.visible.has(row.key)) { card.tick(this.fleet, row); setAttr(card.node, "data-attention", this.fleet.attention(row)); }
    }
    this.mineVersion = this.fleet.mine.size;
    const order = rows.map((row) => row.key).join("\n");
    // A card that has the focus or the pointer is not moved away under it.
    const busy = this.list.querySelector(":hover, :focus-within") !== null;
    if (order !== this.order && !(busy && this.sameKeys(rows))) this.arrange(rows, order);
  }

  // Robots that the server has started and that are not on the network yet.
  drawComing() {
    const known = new Set([...this.fleet.rows.values()].map((row) => row.id));
    const names = this.starting.filter((name) => !known.has(name));
    if (names.join() === this.drawnComing) return;
    this.drawnComing = names.join();
    this.coming.replaceChildren(...names.map((name) => el("li", {}, el("strong", { text: name }), ` ${S.starting}`)));
    this.coming.hidden = names.length === 0;
  }

  sameKeys(rows) {
    return this.list.children.length === rows.length && rows.every((row) => this.cards.get(row.key).node.parentNode === this.list);
  }

  arrange(rows, order) {
    this.order = order;
    const wanted = new Set(rows.map((row) => row.key));
    for (const node of [...this.list.children]) if (!wanted.has(node.dataset.key)) { this.observer.unobserve(node); this.visible.delete(node.dataset.key); node.remove(); }
    for (const key of [...this.cards.keys()]) if (!this.fleet.rows.has(key)) { this.cards.delete(key); this.drawn.delete(key); }
    let at = this.list.firstChild;
    for (const row of rows) {
      const node = this.cards.get(row.key).node;
      if (node === at) { at = at.nextSibling; continue; }
      if (node.parentNode !== this.list) this.observer.observe(node);
      this.list.insertBefore(node, at);
    }
  }

  askThumbnails() {
    const keys = [...this.visible].filter((key) => this.fleet.rows.get(key)?.pictures).slice(0, 12);
    const wanted = this.node.isConnected && !document.hidden ? keys : [];
    if (wanted.join("\n") === this.asked) return;
    this.asked = wanted.join("\n");
    this.state.send({ type: "thumbnails", keys: wanted });
  }

  reconnected() { this.admitted = true; this.asked = ""; this.askThumbnails(); }

  picture(data) {
    const length = new DataView(data).getUint16(0);
    const key = new TextDecoder().decode(new Uint8Array(data, 2, length));
    const card = this.cards.get(key);
    if (!card) return;
    const old = card.picture.src;
    card.picture.src = URL.createObjectURL(new Blob([new Uint8Array(data, 2 + length)], { type: "image/jpeg" }));
    if (old.startsWith("blob:")) URL.revokeObjectURL(old);
  }
}
