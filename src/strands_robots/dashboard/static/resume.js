// Resume stands far from STOP, in words and in place, and asks for the passphrase each time. It opens over the page.
import { el, setText } from "./dom.js";
import { byName, nameText } from "./fleet.js";
import { S } from "./strings.js";

export class Resume {
  constructor(fleet, state) {
    this.fleet = fleet;
    this.state = state;
    this.hello = null;
    this.which = el("p", { class: "which", tabindex: 0 });
    this.hint = el("p");
    this.passphrase = el("input", { id: "resume-passphrase", type: "password", autocomplete: "off" });
    this.button = el("button", { type: "submit", text: S.resumeButton });
    this.said = el("p", { class: "said", role: "status", tabindex: 0, "aria-label": S.resumeSaid });
    this.form = el("form", { novalidate: true }, el("div", { class: "field" }, el("label", { for: "resume-passphrase", text: S.resumePassphrase }), this.passphrase), this.button);
    this.form.addEventListener("submit", (event) => { event.preventDefault(); this.send(); });
    this.node = el("details", { id: "resume" }, el("summary", { text: S.resumeTitle }),
      el("div", { class: "sheet" }, el("p", { text: S.resumeHint }), this.which, this.hint, this.form, this.said));
    this.area = document.getElementById("resume-area");
    this.area.append(this.node);
  }

  locked() { return [...this.fleet.rows.values()].filter((row) => row.locked).sort((a, b) => byName.compare(a.id, b.id)); }

  draw() {
    const locked = this.locked(), hello = this.hello;
    this.area.hidden = locked.length === 0 && !this.node.open;
    setText(this.which, locked.length ? S.resumeWhich(locked.map(nameText).slice(0, 40).join(", ")) : S.resumeNone);
    const why = !hello ? "" : hello.role !== "operator" ? S.viewer : !hello.local ? S.resumeRemote : !hello.operator_key ? S.resumeNoKey : "";
    setText(this.hint, why || (hello && hello.starting.length ? S.resumeDemo : ""));
    this.form.hidden = why !== "" || !hello;
  }

  async send() {
    const passphrase = this.passphrase.value, keys = this.locked().map((row) => row.key);
    this.passphrase.value = "";
    setText(this.said, S.sending);
    const answer = await this.state.ask({ type: "resume", keys, passphrase });
    setText(this.said, answer ? answer.text : S.noAnswer);
    this.said.dataset.tone = answer && answer.ok ? "good" : "bad";
  }
}
