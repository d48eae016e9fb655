// A card for each robot. Cards keep their size and their place: one that comes takes a free place, one that goes leaves
// its own, and they are sorted anew only when somebody asks for it.
import { el, setAttr, setLine, setText, showJpeg } from "./dom.js";
import { ageText, byName, controlText, kindText, lockText, nameText, taskText, verdictText, verdictTone } from "./fleet.js";
import { Filter } from "./filter.js";
import { Halt } from "./halt.js";
import { isRecorder } from "./recorder.js";
import { S } from "./strings.js";

class Card {
  constructor(row, state, onStop) {
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
    this.control = el("p", { class: "small" });
    this.check = el("span", { class: "check" });
    this.age = el("span", { class: "age" });
    this.halt = new Halt(state);
    this.stop = el("button", { type: "button", class: "stop-one", title: S.stopOne(row.id), "aria-label": S.stopOne(row.id), text: S.stopOneShort });
    this.stop.addEventListener("click", () => onStop(row.id));
    this.node = el("li", { class: "card", "data-key": row.key }, this.shot,
      el("div", { class: "body" },
        el("div", { class: "head" }, this.name, this.halt.button),
        this.kind, this.task, this.lock, this.control, el("p", { class: "small" }, this.age, this.check),
        el("div", { class: "foot" }, el("div", { class: "who" }, this.verdict, this.halt.said), this.stop)));
  }

  show(fleet, row) {
    this.halt.of(row);
    setLine(this.name, nameText(row));
    setLine(this.kind, kindText(row));
    setLine(this.task, taskText(row));
    setAttr(this.task, "data-on", fleet.moving(row) ? "yes" : "no");
    // A card that is shown keeps its size until the cards are sorted.
    if (!this.node.isConnected) this.shot.hidden = !row.pictures || isRecorder(row);
    setAttr(this.node, "data-attention", fleet.attention(row));
    setLine(this.lock, lockText(row));
    setAttr(this.lock, "data-tone", row.alarm ? "bad" : row.locked === false ? "quiet" : "warn");
    setLine(this.verdict, row.stop ? `${S.lastStop}: ${verdictText(row.stop)}` : "");
    setAttr(this.verdict, "data-tone", row.stop ? verdictTone(row.stop) : "quiet");
    setLine(this.control, controlText(fleet, row));
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
    this.anew = true;
    this.filter = new Filter(fleet, kindText, () => this.arrangeAnew());
    this.sort = el("button", { id: "sort", type: "button", text: S.sort, title: S.sortWhy });
    this.filter.count.before(this.sort);
    this.list = el("ul", { id: "cards" });
    this.empty = el("p", { class: "empty" });
    this.node = el("div", { id: "fleet" },
      this.filter.node,
      el("div", { class: "places" }, this.empty, this.list));
    this.sort.addEventListener("click", () => this.arrangeAnew());
    this.observer = new IntersectionObserver((entries) => {
      for (const entry of entries) {
        const key = entry.target.dataset.key;
        if (entry.isIntersecting) this.visible.add(key); else this.visible.delete(key);
      }
      this.askThumbnails();
    }, { rootMargin: "100px" });
  }

  arrangeAnew() { this.anew = true; this.draw(); }

  draw() {
    this.fleet.forgetOld();
    const rows = [...this.fleet.rows.values()].filter((row) => this.filter.passes(row));
    const worst = rows.filter((row) => this.fleet.attention(row) < 2).length;
    this.filter.tell(rows.length, worst ? S.worst(worst) : "");
    if (this.anew) { this.list.replaceChildren(); this.observer.disconnect(); this.visible.clear(); }
    for (const row of rows) {
      let card = this.cards.get(row.key);
      if (!card) {
        card = new Card(row, this.state, this.onStop);
        this.cards.set(row.key, card);
      }
      if (this.anew || this.drawn.get(row.key) !== row || this.mineVersion !== this.fleet.mine.size) { card.show(this.fleet, row); this.drawn.set(row.key, row); }
      else if (this.visible.has(row.key)) { card.tick(this.fleet, row); setAttr(card.node, "data-attention", this.fleet.attention(row)); }
    }
    this.mineVersion = this.fleet.mine.size;
    this.place(this.anew ? this.fleet.sorted(rows) : rows);
    this.anew = false;
    const coming = this.list.querySelector(".coming") !== null;
    setText(this.empty, !this.admitted || coming ? "" : this.fleet.rows.size === 0 ? S.none : rows.length === 0 ? S.noMatch : "");
  }

  place(rows) {
    const wanted = new Set(rows.map((row) => row.key));
    for (const node of [...this.list.children]) {
      if (!node.dataset.key || wanted.has(node.dataset.key)) continue;
      this.observer.unobserve(node);
      this.visible.delete(node.dataset.key);
      node.replaceWith(el("li", { class: "place", "aria-hidden": "true", "data-picture": node.querySelector(".shot").hidden ? "no" : "yes" }));
    }
    for (const [key, card] of [...this.cards]) {
      if (this.fleet.rows.has(key)) continue;
      if (card.picture.src.startsWith("blob:")) URL.revokeObjectURL(card.picture.src);
      this.cards.delete(key);
      this.drawn.delete(key);
    }
    const coming = rows.filter((row) => this.cards.get(row.key).node.parentNode !== this.list);
    for (const row of this.anew ? coming : coming.sort((a, b) => byName.compare(a.id, b.id))) {
      const { node, shot } = this.cards.get(row.key);
      const free = this.list.querySelector(`.coming[data-id="${CSS.escape(row.id)}"]`) ||
        this.list.querySelector(`.place[data-picture="${shot.hidden ? "no" : "yes"}"]`);
      if (free) free.replaceWith(node); else this.list.append(node);
      this.observer.observe(node);
    }
    this.placeComing();
  }

  // Robots that the server has started and that are not on the network yet have their places.
  placeComing() {
    const all = this.filter.everything;
    const known = new Set([...this.fleet.rows.values()].map((row) => row.id));
    for (const name of all ? this.starting : []) {
      if (known.has(name) || this.list.querySelector(`.coming[data-id="${CSS.escape(name)}"]`)) continue;
      this.list.append(el("li", { class: "coming", "data-id": name }, el("strong", { text: name }), ` ${S.starting}`));
    }
  }

  askThumbnails() {
    const keys = [...this.visible].filter((key) => this.fleet.rows.get(key)?.pictures && !this.cards.get(key)?.shot.hidden).slice(0, 12);
    const wanted = this.node.isConnected && !document.hidden ? keys : [];
    if (wanted.join("\n") === this.asked) return;
    this.asked = wanted.join("\n");
    this.state.send({ type: "thumbnails", keys: wanted });
  }

  reconnected() { this.admitted = true; this.asked = ""; this.askThumbnails(); }

  picture({ head, jpeg }) {
    const card = this.cards.get(head);
    if (card) showJpeg(card.picture, jpeg);
  }
}
