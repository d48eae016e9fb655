// Everything that a robot can do: its verbs on the left, the form of one and its answer on the right.
import { el, setAttr } from "./dom.js";
import { STOPS, VerbForm } from "./forms.js";
import { S } from "./strings.js";

const CHOICES_MS = 1500;

export class Verbs {
  constructor(state) {
    this.state = state;
    this.hello = null;
    this.list = el("ul", { class: "verb-list", "aria-label": S.verbs });
    this.place = el("div", { class: "verb-place" });
    this.node = el("section", { class: "panel verbs", "aria-labelledby": "verbs-title" }, el("h3", { id: "verbs-title", text: S.verbs }), el("div", { class: "verb-columns" }, this.list, this.place));
  }

  open(key) {
    this.key = key;
    this.signature = "";
    this.names = new Set();
    this.cameras = [];
    this.units = {};
    this.parts = [];
    this.show([]);
  }

  details(detail) {
    this.cameras = detail.cameras;
    this.units = detail.units;
    this.parts = [...new Set(detail.history.flatMap(([, joints]) => Object.keys(joints)))].filter(Boolean);
    // Cameras are choices of the forms; a form that is open is made anew only where they changed.
    const signature = JSON.stringify([detail.forms, this.cameras, this.parts, this.hello && this.hello.role]);
    if (signature === this.signature) return;
    this.signature = signature;
    this.show(detail.forms);
  }

  show(forms) {
    this.forms = new Map();
    this.names = new Set(forms.map((form) => form.name));
    this.buttons = new Map(forms.map((form) => {
      const kind = STOPS.includes(form.name) ? S.stops : form.kind === "read" ? S.reads : form.changes ? S.changes : S.moves;
      const button = el("button", { type: "button", class: "verb", "data-verb": form.name }, el("code", { text: form.name }), " ", el("span", { class: "does", "data-kind": form.kind, text: form.own ? S.ownKind(kind) : kind }));
      button.addEventListener("click", () => this.choose(form));
      return [form.name, button];
    }));
    this.list.replaceChildren(...[...this.buttons.values()].map((button) => el("li", {}, button)));
    this.place.replaceChildren(el("p", { class: "small", text: S.verbsHint }));
    const form = forms.find((each) => each.name === this.chosen);
    if (form) this.choose(form);
  }

  async choose(form) {
    this.chosen = form.name;
    for (const [name, button] of this.buttons) setAttr(button, "aria-pressed", name === form.name);
    let made = this.forms.get(form.name);
    if (!made) {
      made = new VerbForm(form, this.robot(), Boolean(this.hello && this.hello.role === "operator"));
      this.forms.set(form.name, made);
    }
    // It is shown once it knows its choices; of a robot that is slow to answer, without them.
    await Promise.race([made.fill(), new Promise((done) => setTimeout(done, CHOICES_MS))]);
    if (this.chosen === form.name && this.forms.get(form.name) === made) { made.shown = true; this.place.replaceChildren(made.node); }
  }

  // What a form asks of the robot.
  robot() {
    const key = this.key, ask = (call) => this.state.ask({ type: "call", key, ...call });
    const read = async (verb) => { const answer = await ask({ verb, params: {} }); return answer && answer.ok ? answer.facts : {}; };
    return {
      ask,
      has: (verb) => this.names.has(verb),
      cameras: () => this.cameras,
      parts: () => this.parts,
      slides: (joint) => this.units[joint] === "metres",
      objects: async () => { const { objects } = await read("getObjects"); return Array.isArray(objects) ? objects.map((each) => String(each.name)) : Object.keys(objects || {}); },
      pose: async () => { const { joints } = await read("getPose"); return joints && typeof joints === "object" ? joints : {}; },
    };
  }
}
