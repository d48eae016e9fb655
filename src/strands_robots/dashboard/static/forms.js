// A form for a verb, made from its description: the fields that it needs, and the others folded.
import { el, setAttr, setText } from "./dom.js";
import { resultNodes } from "./result.js";
import { S } from "./strings.js";

// A stop needs no leave to move: viewers have it, too.
export const STOPS = ["stop", "stopMotion"];

const DIRECTIONS = ["forward", "back", "left", "right", "up", "down"];

function choose(id, values, empty) {
  const input = el("select", { id });
  if (empty !== null) input.append(el("option", { value: "", text: empty }));
  input.append(...values.map((value) => el("option", { value, text: value })));
  return input;
}

// The values of a choice come from the robot, and what was chosen stays chosen while it is there.
function refill(input, values) {
  const chosen = input.value, empty = input.options[0] && input.options[0].value === "" ? input.options[0] : null;
  input.replaceChildren(...(empty ? [empty] : []), ...values.map((value) => el("option", { value, text: value })));
  if (values.includes(chosen)) input.value = chosen;
}

class Field {
  constructor(verb, parameter, robot) {
    this.parameter = parameter;
    this.robot = robot;
    const id = `p-${verb}-${parameter.name}`, empty = parameter.required ? null : S.notGiven;
    const number = ["number", "integer"].includes(parameter.type);
    if (parameter.type === "boolean") {
      this.input = el("select", { id }, el("option", { value: "true", text: S.yes }), el("option", { value: "false", text: S.no }));
      this.input.value = String(parameter.default ?? true);
    } else if (parameter.enum.length) {
      this.input = choose(id, parameter.enum.map(String), empty);
      if (parameter.default !== null) this.input.value = String(parameter.default);
    } else if (parameter.choices === "directions") this.input = choose(id, DIRECTIONS, empty);
    else if (parameter.choices === "cameras") this.input = choose(id, robot.cameras(), empty);
    else if (parameter.choices === "robots") this.input = choose(id, robot.parts(), empty);
    else if (parameter.choices === "objects" && robot.has("getObjects")) this.input = choose(id, [], empty);
    else {
      this.input = el("input", { id, type: "text", inputmode: number ? "decimal" : null, autocomplete: "off", spellcheck: "false", placeholder: parameter.type === "object" ? '{"joint": 10}' : "" });
      if (parameter.default !== null && parameter.default !== undefined) this.input.value = String(parameter.default);
    }
    this.input.setAttribute("aria-describedby", `${id}-meaning`);
    const label = (parameter.unit ? `${parameter.name}, ${parameter.unit}` : parameter.name) + (parameter.required ? ` (${S.required})` : "");
    this.joints = parameter.choices === "joints" && robot.has("getPose") ? el("div", { class: "joint-fields" }) : null;
    this.node = el("div", { class: "field" }, el("label", { for: id, text: label }), this.input,
      el("small", { id: `${id}-meaning`, text: [parameter.meaning, S.within(parameter)].filter(Boolean).join(" ") }), this.joints);
  }

  async fill(shown) {
    if (this.parameter.choices === "objects" && this.input instanceof HTMLSelectElement) refill(this.input, await this.robot.objects());
    if (this.joints && !this.each) this.makeJoints(await this.robot.pose(), shown());
  }

  // A field for each joint in place of an object that is typed; one that is left empty stays where it is.
  makeJoints(pose, shown) {
    const names = Object.keys(pose);
    if (!names.length || shown) return;
    this.each = names.map((name) => [name, el("input", { id: `${this.input.id}-${name}`, type: "text", inputmode: "decimal", autocomplete: "off", placeholder: S.jointAt(pose[name], this.robot.slides(name) ? 3 : 1) })]);
    this.joints.replaceChildren(...this.each.flatMap(([name, input]) => [el("label", { for: input.id, text: `${name}, ${this.robot.slides(name) ? "m" : "\u00b0"}` }), input]));
    this.input.hidden = true;
    this.node.firstChild.removeAttribute("for");
  }

  value() {
    if (!this.each) return valueOf(this.parameter, this.input.value);
    const number = { type: "number", required: false }, found = {};
    for (const [name, input] of this.each) {
      const value = valueOf({ ...number, name }, input.value);
      if (value !== undefined) found[name] = value;
    }
    if (!Object.keys(found).length) throw new Error(S.missing(this.parameter.name));
    return found;
  }
}

export function valueOf(parameter, text) {
  const given = text.trim();
  if (given === "") {
    if (parameter.required) throw new Error(S.missing(parameter.name));
    return undefined;
  }
  // What was chosen is a text, and the robot gets the value that it named.
  if (parameter.enum && parameter.enum.length) return parameter.enum.find((each) => String(each) === given);
  if (parameter.type === "boolean") return given === "true";
  if (["number", "integer"].includes(parameter.type)) {
    const value = Number(given);
    if (!Number.isFinite(value)) throw new Error(S.badNumber(parameter.name));
    if (parameter.type === "integer" && !Number.isInteger(value)) throw new Error(S.notWhole(parameter.name));
    if (value < (parameter.low ?? value) || value > (parameter.high ?? value)) throw new Error(S.outOfBounds(parameter));
    return value;
  }
  if (["object", "array"].includes(parameter.type)) {
    try { return JSON.parse(given); } catch { throw new Error(S.badJson(parameter.name)); }
  }
  return text;
}

export class VerbForm {
  constructor(form, robot, canMove) {
    this.form = form;
    this.robot = robot;
    this.shown = false;
    this.fields = form.parameters.map((parameter) => new Field(form.name, parameter, robot));
    const shown = this.fields.filter((each) => each.parameter.shown), folded = this.fields.filter((each) => !each.parameter.shown);
    this.said = el("div", { class: "said", role: "status", tabindex: 0, "aria-label": S.result(form.name) });
    const run = el("button", { type: "submit", class: "primary", text: S.run, disabled: form.kind !== "read" && !canMove && !STOPS.includes(form.name) });
    this.node = el("form", { novalidate: true, "data-verb": form.name },
      el("div", { class: "asked" }, el("h4", {}, el("code", { text: form.name })), el("p", { class: "small", text: form.summary }), form.own ? el("p", { class: "small own", text: S.ownVerb }) : null, ...shown.map((each) => each.node), run),
      this.said,
      folded.length ? el("details", { class: "more" }, el("summary", { text: S.more(folded.length) }), ...folded.map((each) => each.node)) : null);
    this.node.addEventListener("submit", (event) => { event.preventDefault(); this.run(); });
  }

  // What can be chosen is asked of the robot when the form is opened, and after what may have changed it.
  async fill() { await Promise.all(this.fields.map((each) => each.fill(() => this.shown))); }

  say(text, tone, ...more) {
    setAttr(this.said, "data-tone", tone);
    const words = el("p");
    this.said.replaceChildren(words, ...more);
    setText(words, text);
  }

  async run() {
    const params = {};
    try {
      for (const field of this.fields) {
        const value = field.value();
        if (value !== undefined) params[field.parameter.name] = value;
      }
    } catch (problem) {
      this.say(problem.message, "bad");
      return;
    }
    this.say(S.sending, "warn");
    const answer = await this.robot.ask({ verb: this.form.name, params });
    if (!answer) this.say(S.noAnswer, "bad");
    else this.say(answer.text, answer.ok ? "good" : "bad", ...resultNodes(answer.facts));
    if (this.form.kind !== "read") await this.fill();
  }
}
