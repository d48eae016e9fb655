// The answer to a verb as tables: a row for each fact, and a column for each of a list of like things.
import { el } from "./dom.js";
import { labelOf, textOf } from "./events.js";

const ROWS_MAX = 200, DEEP_MAX = 4;
const plain = (value) => value === null || typeof value !== "object";

export function resultNodes(facts) {
  const shown = Object.entries(facts || {}).filter(([, value]) => value !== null && value !== "");
  return shown.length ? [table(Object.fromEntries(shown), 0)] : [];
}

function table(facts, deep) {
  return el("table", { class: "facts" }, el("tbody", {}, ...Object.entries(facts).slice(0, ROWS_MAX).map(([name, value]) =>
    el("tr", {}, el("th", { scope: "row", text: labelOf(name) }), el("td", {}, content(name, value, deep))))));
}

function content(name, value, deep) {
  if (plain(value)) return textOf(name, value);
  if (deep >= DEEP_MAX) return JSON.stringify(value);
  if (!Array.isArray(value)) {
    const each = Object.entries(value);
    if (!each.length) return "\u2013";
    return each.every(([, own]) => !plain(own) && !Array.isArray(own)) ? rows(each, deep, true) : table(value, deep + 1);
  }
  if (value.every(plain)) return value.length ? value.map((each) => textOf(name, each)).join(", ") : "\u2013";
  if (value.some((each) => plain(each) || Array.isArray(each))) return JSON.stringify(value);
  return rows(value.map((each, index) => [index, each]), deep, false);
}

function rows(pairs, deep, named) {
  const columns = [...new Set(pairs.flatMap(([, each]) => Object.keys(each)))];
  return el("table", { class: "rows" },
    el("thead", {}, el("tr", {}, named ? el("td") : null, ...columns.map((each) => el("th", { scope: "col", text: labelOf(each) })))),
    el("tbody", {}, ...pairs.slice(0, ROWS_MAX).map(([name, each]) => el("tr", {}, named ? el("th", { scope: "row", text: name }) : null,
      ...columns.map((column) => el("td", {}, each[column] === undefined ? "" : content(column, each[column], deep + 1)))))));
}
