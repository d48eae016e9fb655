// A policy and the hand of this page, in turns: a push takes over, and the policy gets it back by a button.
import { el, setAttr, setShown, setText } from "./dom.js";
import { S } from "./strings.js";

const MOCK = "mock";
const ALIVE_MS = 250;
const SIMULATED = ["strands_sim", "sim"];

export class Turns {
  constructor(state, pictures) {
    this.state = state;
    this.pictures = pictures;
    this.key = "";
    this.policy = el("input", { id: "turn-policy", type: "text", autocomplete: "off", spellcheck: "false", value: MOCK });
    this.task = el("input", { id: "turn-task", type: "text", autocomplete: "off", placeholder: S.turnTaskHint });
    this.camera = el("select", { id: "turn-camera" });
    this.go = el("button", { type: "button", class: "turn" });
    this.finish = el("button", { type: "button", text: S.turnEnd });
    this.said = el("p", { class: "turn-said", role: "status" });
    this.go.addEventListener("click", () => this.press());
    this.camera.addEventListener("change", () => { this.chosen = true; });
    this.finish.addEventListener("click", () => this.ask({ type: "end_lead" }));
    this.node = el("fieldset", { class: "turns" }, el("legend", { text: S.turnTitle }),
      el("div", { class: "turn-fields" }, ...[[this.policy, S.turnPolicy], [this.task, S.turnTask], [this.camera, S.turnCamera]].flatMap(([input, text]) => [el("label", { for: input.id, text }), input])),
      el("div", { class: "tools" }, this.go, this.finish), this.said);
    state.addEventListener("turn", ({ detail }) => { if (detail.key === this.key) this.turned(detail); });
    state.addEventListener("lost", () => { if (this.on) this.turned({ state: "over", why: S.turnLost }); });
    // The server stops a robot that is led by a page of which it hears nothing.
    setInterval(() => { if (this.on && !document.hidden) state.send({ type: "alive", key: this.key }); }, ALIVE_MS);
    document.addEventListener("visibilitychange", () => { if (document.hidden) this.close(); });
  }

  get on() { return ["policy", "led", "held"].includes(this.now); }

  open(key) {
    this.key = key;
    this.now = "";
    this.listed = null;
    this.chosen = false;
    this.node.hidden = true;
    this.say("", "quiet");
    this.draw(false, null);
  }

  // A policy does not drive what nobody looks at.
  close() { if (this.on) this.ask({ type: "end_lead" }); }

  details(detail) {
    this.node.hidden = !detail.led;
    const listed = JSON.stringify(detail.cameras);
    if (listed === this.listed) return;
    this.listed = listed;
    const before = this.camera.value;
    this.camera.replaceChildren(el("option", { value: "", text: S.turnState }), ...detail.cameras.map((name) => el("option", { value: name, text: S.turnPictures(name) })));
    if (this.chosen && detail.cameras.includes(before)) this.camera.value = before;
    else this.chosen = false;
  }

  say(text, tone) {
    setText(this.said, text);
    setAttr(this.said, "data-tone", tone);
  }

  async ask(message) {
    const key = this.key, answer = await this.state.ask({ ...message, key });
    if (key === this.key && !(answer && answer.ok)) this.say(answer ? answer.text : S.noAnswer, "bad");
    return Boolean(answer && answer.ok);
  }

  async press() {
    if (this.on) { await this.ask({ type: "give_back" }); return; }
    const camera = this.camera.value, key = this.key;
    this.go.disabled = true;
    this.say(S.turnBegins, "warn");
    const begun = await this.ask({ type: "lead", policy: this.policy.value.trim(), task: this.task.value.trim(), camera });
    if (!begun) return;
    if (key !== this.key || document.hidden) this.state.ask({ type: "end_lead", key });
    else if (camera) this.pictures.led(camera);
  }

  turned({ state, why, stopped, text }) {
    this.now = state;
    if (state === "over") {
      this.pictures.ledNoMore();
      if (stopped === false || stopped === null) this.say(S.jogNotStopped(text), "bad");
      else this.say(S.turnOver(why), why ? "warn" : "good");
    } else this.say(state === "held" ? S.turnHeld(why) : S.turns[state], state === "policy" ? "good" : "warn");
  }

  // A simulation that stands still gives the same picture again, which is no new one: it is driven by its state.
  draw(may, row) {
    if (row && !this.chosen && !SIMULATED.includes(row.kind)) this.camera.value = this.pictures.chosen.value;
    const other = this.on && this.now !== "policy";
    setText(this.go, this.on ? S.turnBack : S.turnGo);
    setAttr(this.go, "class", this.on ? "turn primary" : "turn");
    this.go.disabled = !may || (this.on && !other);
    this.finish.disabled = !this.on;
    for (const input of [this.policy, this.task, this.camera]) input.disabled = this.on;
    setShown(this.said, this.said.textContent !== "");
  }
}
