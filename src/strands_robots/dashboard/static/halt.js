// Halt: one click ends what one robot does, without a lockout. Viewers have it, too.
import { el, setAttr, setLine } from "./dom.js";
import { S } from "./strings.js";

export class Halt {
  constructor(state) {
    this.state = state;
    this.key = "";
    this.button = el("button", { type: "button", class: "halt", text: S.halt });
    this.said = el("p", { class: "halt-said", role: "status" });
    this.button.addEventListener("click", () => this.press());
  }

  of(row) {
    if (row.key !== this.key) this.say("", "quiet");
    this.key = row.key;
    setAttr(this.button, "aria-label", S.haltOne(row.id));
    setAttr(this.button, "title", row.namesake ? S.haltNamesakes(row.id) : S.haltWhy(row.id));
  }

  say(text, tone) {
    setLine(this.said, text);
    setAttr(this.said, "data-tone", tone);
  }

  async press() {
    const key = this.key, began = performance.now();
    this.say(S.halting, "warn");
    const answer = await this.state.ask({ type: "call", key, verb: "stop", params: {} });
    if (key !== this.key) return;
    const at = S.when(new Date());
    if (!answer) this.say(S.haltNotSent, "bad");
    else if (answer.ok) this.say(S.halted(at, Math.round(performance.now() - began)), "good");
    else this.say(S.notHalted(answer.text), "bad");
  }
}
