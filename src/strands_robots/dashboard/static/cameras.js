// A grid of the cameras of all robots that have one, twelve at a time, one picture a second each.
import { el, setAttr, setText, showJpeg } from "./dom.js";
import { Filter } from "./filter.js";
import { byName, kindText, nameText } from "./fleet.js";
import { H } from "./history-strings.js";

const TILES = 12, OLD_MS = 5000, AGAIN_MS = 10_000;

class Tile {
  constructor() {
    this.picture = el("img", { class: "tile-picture", alt: "" });
    this.name = el("a", { class: "name" });
    this.said = el("span", { class: "tile-said" });
    this.node = el("li", { class: "tile" }, el("div", { class: "tile-frame" }, this.picture), this.name, this.said);
  }

  show(row) {
    const key = row ? row.key : "";
    setText(this.name, row ? nameText(row) : "");
    if (key === this.key) return;
    this.key = key;
    this.at = 0;
    this.since = performance.now();
    if (this.picture.src.startsWith("blob:")) URL.revokeObjectURL(this.picture.src);
    this.picture.removeAttribute("src");
    this.picture.alt = row ? H.picture(row.id) : "";
    // Tiles keep their places; one without a robot is only not seen.
    setAttr(this.node, "data-empty", row ? "no" : "yes");
    if (row) this.name.href = `#/robot/${encodeURIComponent(key)}`; else this.name.removeAttribute("href");
  }

  take(bytes) {
    showJpeg(this.picture, bytes);
    this.at = Date.now();
  }

  tell(paused) {
    const old = this.at ? Date.now() - this.at > OLD_MS : performance.now() - this.since > OLD_MS;
    const text = paused ? H.paused : this.at ? (old ? H.old(H.time(this.at)) : H.live(H.time(this.at))) : old ? H.never : H.waiting;
    setText(this.said, this.key ? text : "");
    setAttr(this.node, "data-old", (paused || old) && this.key ? "yes" : "no");
  }
}

export class CamerasView {
  constructor(fleet, state) {
    this.fleet = fleet;
    this.state = state;
    this.first = 0;
    this.paused = false;
    this.filter = new Filter(fleet, kindText, () => { this.first = 0; this.list(); }, "cameras-");
    this.tiles = Array.from({ length: TILES }, () => new Tile());
    this.which = el("span", { class: "page-of", role: "status" });
    this.previous = el("button", { type: "button", text: H.previous });
    this.next = el("button", { type: "button", text: H.next });
    this.pause = el("button", { type: "button", class: "pause", text: H.pause });
    this.previous.addEventListener("click", () => this.turn(-TILES));
    this.next.addEventListener("click", () => this.turn(TILES));
    this.pause.addEventListener("click", () => { this.paused = !this.paused; setText(this.pause, this.paused ? H.go : H.pause); this.ask(); this.draw(); });
    this.node = el("div", { id: "cameras" }, el("h2", { text: H.cameras }), this.filter.node,
      el("div", { class: "tools pages" }, this.previous, this.next, this.pause, this.which),
      el("ul", { class: "tiles" }, ...this.tiles.map((tile) => tile.node)));
    setInterval(() => { if (this.node.isConnected) { this.list(true); this.draw(); } }, 1000);
    setInterval(() => this.ask(true), AGAIN_MS);
  }

  open() { this.filter.open(); this.list(); this.ask(true); }

  // Called while it is still shown.
  close() { this.asked = ""; this.state.send({ type: "thumbnails", keys: [] }); }

  turn(by) { this.first += by; this.list(true); }

  // Robots keep their places while the view is open and the filter is the same: one that comes stands last, and the
  // tile of one that passes no more is only not seen.
  list(keep = false) {
    const rows = [...this.fleet.rows.values()].filter((row) => row.pictures && this.filter.passes(row));
    const found = new Map(rows.map((row) => [row.key, row])), old = keep && this.order ? this.order : [];
    const known = new Set(old);
    this.order = old.concat(rows.filter((row) => !known.has(row.key)).sort((a, b) => byName.compare(a.id, b.id)).map((row) => row.key));
    this.first = Math.max(0, Math.min(this.first, Math.floor(Math.max(0, this.order.length - 1) / TILES) * TILES));
    const shown = this.order.slice(this.first, this.first + TILES);
    this.tiles.forEach((tile, index) => tile.show(found.get(shown[index])));
    setText(this.which, H.page(this.first + 1, this.first + shown.length, found.size ? this.order.length : 0));
    this.previous.disabled = this.first === 0;
    this.next.disabled = this.first + TILES >= this.order.length;
    this.filter.tell([...this.fleet.rows.values()].filter((row) => this.filter.passes(row)).length);
    this.keys = shown.filter((key) => found.has(key));
    this.ask();
  }

  // Pictures are asked for only while they are seen.
  ask(again = false) {
    if (!this.node.isConnected) return;
    const wanted = document.hidden || this.paused ? [] : this.keys || [];
    if (!again && wanted.join("\n") === this.asked) return;
    this.asked = wanted.join("\n");
    this.state.send({ type: "thumbnails", keys: wanted });
  }

  picture({ head, jpeg }) {
    const tile = this.tiles.find((each) => each.key === head);
    if (tile && !this.paused) { tile.take(jpeg); tile.tell(false); }
  }

  draw() { for (const tile of this.tiles) tile.tell(this.paused); }
}
