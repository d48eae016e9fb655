// A form for every verb, made from its description.
import { el, setText } from "./dom.js";
import { S } from "./strings.js";

// A stop needs no leave to move: viewers have it, too.
const STOPS = ["stop", "stopMotion"];

function field(verb, parameter) {
  const id = `p-${verb}-${parameter.name}`;
  let input;
  if (parameter.type === "boolean") {
    input = el("select", { id }, el("option", { value: "true", text: "true" }), el("option", { value: "false", text: "false" }));
    input.value = String(parameter.default ?? true);
  } else {
    const number = ["number", "integer"].includes(parameter.type);
    input = el("input", { id, type: "text", inputmode: number ? "decimal" : null, autocomplete: "off", spellcheck: "false", placeholder: parameter.type === "object" ? '{"joint": 10}' : "" });
    if (parameter.default !== null && parameter.default !== undefined) input.value = String(parameter.default);
  }
  input.setAttribute("aria-describedby", `${id}-meaning`);
  return [input, el("div", { class: "field" },
    el("label", { for: id, text: parameter.required ? `${parameter.name} (${S.required})` : parameter.name }), input,
    el("small", { id: `${id}-meaning`, text: parameter.meaning }))];
}

export function valueOf(parameter, text) {
  const given = text.trim();
  if (given === "") {
    if (parameter.required) throw new Error(S.missing(parameter.name));
    return undefined;
  }
  if (parameter.type === "boolean") return given === "true";
  if (["number", "integer"].includes(parameter.type)) {
    const value = Number(given);
    if (!Number.isFinite(value)) throw new Error(S.badNumber(parameter.name));
    return value;
  }
  if (["object", "array"].includes(parameter.type)) {
    try { return JSON.parse(given); } catch { throw new Error(S.badJson(parameter.name)); }
  }
  return text;
}

export function verbForm(form, ask, canMove) {
  const fields = form.parameters.map((parameter) => [parameter, ...field(form.name, parameter)]);
  const said = el("p", { class: "said", role: "status" });
  const run = el("button", { type: "submit", text: S.run, disabled: form.kind !== "read" && !canMove && !STOPS.includes(form.name) });
  const node = el("form", { novalidate: true }, el("p", { text: form.summary }), ...fields.map((each) => each[2]), run, said);
  node.addEventListener("submit", async (event) => {
    event.preventDefault();
    const params = {};
    try {
      for (const [parameter, input] of fields) {
        const value = valueOf(parameter, input.value);
        if (value !== undefined) params[parameter.name] = value;
      }
    } catch (problem) {
      setText(said, problem.message);
      said.dataset.tone = "bad";
      return;
    }
    setText(said, S.sending);
    said.dataset.tone = "warn";
    const answer = await ask({ verb: form.name, params });
    said.dataset.tone = answer && answer.ok ? "good" : "bad";
    const facts = answer && answer.facts && Object.keys(answer.facts).length ? ` ${JSON.stringify(answer.facts, null, 1)}` : "";
    setText(said, answer ? `${answer.text}${facts}`.slice(0, 4000) : S.noAnswer);
  });
  return el("details", { class: "verb" },
    el("summary", {}, el("code", { text: form.name }), " ", el("span", { class: "does", "data-kind": form.kind, text: STOPS.includes(form.name) ? S.stops : form.kind === "read" ? S.reads : S.moves })), node);
}
