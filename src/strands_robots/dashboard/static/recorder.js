// A recording: how far it is, and a button for each word of a person. All have their places; those that fit now work.
import { el, setAttr, setLine, setText } from "./dom.js";
import { S } from "./strings.js";

const LOOK_MS = 500;
const WORDS = [
  ["begin", "beginEpisode", {}],
  ["success", "keepEpisode", { success: true }],
  ["failure", "keepEpisode", { success: false }],
  ["redo", "redoEpisode", {}],
  ["end", "endRecording", {}],
];

export const isRecorder = (row) => Boolean(row) && row.kind === "recorder";

export class Recorder {
  constructor(state) {
    this.state = state;
    this.viewer = null;
    this.key = "";
    this.number = 0;
    this.where = el("p", { class: "recording-where" });
    this.figures = el("p", { class: "recording-figures" });
    this.said = el("p", { class: "small recording-said" });
    this.answer = el("p", { class: "said recording-answer", role: "status" });
    this.buttons = WORDS.map(([name, verb, params]) => {
      const button = el("button", { type: "button", class: "word", "data-word": name, disabled: true, text: S.recorder.words[name] });
      button.addEventListener("click", () => this.press(verb, params));
      return [button, verb];
    });
    this.node = el("section", { class: "panel recorder", "aria-labelledby": "recorder-title", hidden: true },
      el("h3", { id: "recorder-title", text: S.recorder.title }), this.where, this.figures, this.said,
      el("div", { class: "words" }, ...this.buttons.map(([button]) => button)), this.answer);
  }

  open(key, shown) {
    this.close();
    this.key = key;
    this.node.hidden = !shown;
    this.tell(null);
    setLine(this.said, "");
    this.say(this.viewer ? S.viewer : "", "quiet");
    if (!shown) return;
    this.look();
    this.timer = setInterval(() => this.look(), LOOK_MS);
  }

  close() {
    clearInterval(this.timer);
    this.key = "";
    this.asking = false;
  }

  set hello(hello) {
    this.viewer = hello.role !== "operator";
    if (this.viewer) this.say(S.viewer, "quiet");
  }

  // One question at a time; a page that nobody sees asks nothing.
  async look() {
    if (this.asking || document.hidden) return;
    const key = this.key, number = ++this.number;
    this.asking = true;
    const answer = await this.state.ask({ type: "call", key, verb: "getRecording", params: {} });
    if (key !== this.key) return;
    this.asking = false;
    // What was asked before a press says nothing of it.
    if (number === this.number) this.tell(answer && answer.ok ? answer.facts : null, answer && !answer.ok ? answer.text : "");
  }

  tell(facts, problem = "") {
    const can = facts && Array.isArray(facts.can) ? facts.can : [];
    for (const [button, verb] of this.buttons) button.disabled = this.viewer !== false || !can.includes(verb);
    setAttr(this.node, "data-state", facts ? facts.state : "unknown");
    setLine(this.where, facts ? S.recorder.where(facts) : problem ? S.recorder.gone : S.recorder.unknown);
    setLine(this.figures, facts ? S.recorder.figures(facts) : problem);
    // What became of the last episode stays where the recording is over.
    if (facts) setLine(this.said, String(facts.said ?? ""));
  }

  async press(verb, params) {
    const key = this.key;
    this.number += 1;
    for (const [button] of this.buttons) button.disabled = true;
    this.say(S.sending, "warn");
    const answer = await this.state.ask({ type: "call", key, verb, params });
    if (key !== this.key) return;
    if (!answer) this.say(S.noAnswer, "bad");
    else this.say(answer.ok ? "" : answer.text, answer.ok ? "good" : "bad");
    this.look();
  }

  say(text, tone) {
    setText(this.answer, text);
    setAttr(this.answer, "data-tone", tone);
  }
}
