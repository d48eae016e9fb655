// Hold to run. A jog lives by its beats: every way of letting go ends them, and the server stops without them.
import { el, setText, typing } from "./dom.js";
import { S } from "./strings.js";

const BEAT_MS = 50;
const UP = "qwertyuiop", DOWN = "asdfghjkl;";
const DEAD_ZONE = 0.35;
const OWN = ["released", "the page was hidden"];

export class Jog {
  constructor(state, said) {
    this.state = state;
    this.said = said;
    this.key = "";
    this.part = "";
    this.speed = 0.3;
    this.enabled = false;
    this.now = null;
    this.axes = [];
    this.timer = this.frame = 0;
    this.padAxis = "";
    document.addEventListener("visibilitychange", () => { if (document.hidden) this.end("hidden"); });
    for (const name of ["blur", "pagehide", "freeze"]) window.addEventListener(name, () => this.end("hidden"));
    window.addEventListener("keydown", (event) => this.keyDown(event));
    window.addEventListener("keyup", (event) => { if (this.now && this.now.by === event.code) this.end("released"); });
    state.addEventListener("lost", () => { this.end("lost"); this.setEnabled(false); });
    state.addEventListener("jogged", ({ detail }) => this.ended(detail));
    state.addEventListener("let_go", ({ detail }) => this.letGo(detail));
  }

  setEnabled(enabled) {
    if (enabled === this.enabled) return;
    this.enabled = enabled;
    if (!enabled) this.end("released");
    for (const button of document.querySelectorAll("button.jog")) button.disabled = !enabled;
    cancelAnimationFrame(this.frame);
    if (enabled) this.pollPad();
  }

  begin(axis, by, node) {
    if (!this.enabled || this.now || document.hidden) return;
    const sent = this.state.send({ type: "jog", key: this.key, kind: axis.kind, axis: axis.axis, direction: axis.direction, speed: this.speed, part: this.part });
    if (!sent) return;
    this.now = { axis, by, node, key: this.key };
    if (node) node.classList.add("held");
    setText(this.said, S.jogging(axis.label));
    this.said.dataset.tone = "warn";
    this.timer = setInterval(() => this.state.send({ type: "beat", key: this.now ? this.now.key : "" }), BEAT_MS);
  }

  end(why) {
    if (!this.now) return;
    clearInterval(this.timer);
    this.state.send({ type: "unjog", key: this.now.key, why });
    if (this.now.node) this.now.node.classList.remove("held");
    this.now = null;
  }

  letGo({ key, why }) {
    // What this page let go of is over here already, and another push may be on.
    const own = OWN.includes(why);
    if (key !== this.key || (own && this.now)) return;
    if (!own) this.over({ key });
    setText(this.said, S.letGo(why));
    this.said.dataset.tone = "warn";
  }

  over(detail) {
    if (!this.now || this.now.key !== detail.key) return;
    clearInterval(this.timer);
    if (this.now.node) this.now.node.classList.remove("held");
    this.now = null;
  }

  ended(detail) {
    this.over(detail);
    if (detail.began === false) { setText(this.said, S.jogRefused(detail.why)); this.said.dataset.tone = "warn"; return; }
    if (detail.stopped !== true) { setText(this.said, S.jogNotStopped(detail.text || detail.why)); this.said.dataset.tone = "bad"; return; }
    setText(this.said, detail.refused ? S.jogRefused(detail.why) : S.jogStopped(detail.why, detail.ms));
    this.said.dataset.tone = detail.refused ? "warn" : "good";
  }

  button(kind, axis, direction, label, text, keyHint) {
    const what = { kind, axis, direction, label };
    const node = el("button", { type: "button", class: "jog", disabled: !this.enabled, "aria-label": label, "aria-keyshortcuts": keyHint || null, "data-key": keyHint || null, "data-way": direction > 0 ? "plus" : "minus", text });
    node.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      // Released over the button or anywhere else, the pointer is ours.
      node.setPointerCapture(event.pointerId);
      this.begin(what, `pointer ${event.pointerId}`, node);
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
      node.addEventListener(name, (event) => { if (this.now && this.now.by === `pointer ${event.pointerId}`) this.end("released"); });
    }
    node.addEventListener("contextmenu", (event) => event.preventDefault());
    node.addEventListener("keydown", (event) => {
      if (event.code !== "Enter") return;
      event.preventDefault();
      event.stopPropagation();
      if (!event.repeat) this.begin(what, "Enter", node);
    });
    node.addEventListener("blur", () => { if (this.now && this.now.node === node) this.end("released"); });
    this.axes.push({ ...what, node, key: keyHint });
    return node;
  }

  keyDown(event) {
    if (event.repeat || event.ctrlKey || event.altKey || event.metaKey || typing(event.target) || event.target instanceof HTMLSelectElement) return;
    const found = this.axes.find((each) => each.key && each.key === event.key.toLowerCase());
    if (found && this.enabled) { event.preventDefault(); this.begin(found, event.code, found.node); }
  }

  keysOf(index) { return [UP[index], DOWN[index]]; }

  // Sticks move the first joints in order, or a base forward and around.
  pollPad() {
    if (!this.enabled) return;
    const pads = navigator.getGamepads ? [...navigator.getGamepads()].filter(Boolean) : [];
    let pushed = null;
    for (const pad of pads) pad.axes.forEach((value, index) => { if (!pushed && Math.abs(value) > DEAD_ZONE) pushed = [index, Math.sign(value)]; });
    const name = pushed ? pushed.join("/") : "";
    if (name !== this.padAxis) {
      if (this.now && this.now.by === "gamepad") this.end("released");
      this.padAxis = name;
      if (pushed) {
        const kinds = this.axes.some((each) => each.kind === "joint") ? "joint" : "base";
        const plus = this.axes.filter((each) => each.kind === kinds && each.direction === 1);
        const minus = this.axes.filter((each) => each.kind === kinds && each.direction === -1);
        const axis = (pushed[1] > 0 ? plus : minus)[pushed[0]];
        if (axis) this.begin(axis, "gamepad", axis.node);
      }
    }
    this.frame = requestAnimationFrame(() => this.pollPad());
  }
}
