// Files of the history as it is shown, with units in their headers.
import { el } from "./dom.js";
import { H } from "./history-strings.js";

const iso = (seconds) => new Date(seconds * 1000).toISOString();

// A text that a spreadsheet would run as a formula is marked as text.
function cell(value) {
  if (value === null || value === undefined) return "";
  const text = typeof value === "string" && /^[=+\-@\t\r]/.test(value) ? `'${value}` : String(value);
  return /[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

const lines = (rows) => `${rows.map((row) => row.map(cell).join(",")).join("\r\n")}\r\n`;

// `states` are {row, intervals: [[state, wall seconds, wall seconds]...]}.
export function statesCsv(states) {
  return lines([["robot", "network", "kind", "state", "from (ISO 8601, UTC)", "to (ISO 8601, UTC)", "duration (s)"],
    ...states.flatMap(({ row, intervals }) => intervals.map(([state, from, to]) =>
      [row.id, row.network, row.kind, H.states[state], iso(from), iso(to), Number((to - from).toFixed(2))]))]);
}

// `series` is {id, columns: [{name, unit, values}], times: wall seconds}.
export function chartsCsv(series) {
  return lines([["robot", "time (ISO 8601, UTC)", ...series.columns.map((each) => `${each.name} (${each.unit})`)],
    ...series.times.map((at, index) => [series.id, iso(at), ...series.columns.map((each) => each.values[index])])]);
}

export function bothJson(states, series, seconds) {
  return `${JSON.stringify({
    made_at: new Date().toISOString(),
    window_s: seconds,
    states: states.flatMap(({ row, intervals }) => intervals.map(([state, from, to]) =>
      ({ robot: row.id, network: row.network, kind: row.kind, state: H.states[state], from: iso(from), to: iso(to), duration_s: Number((to - from).toFixed(2)) }))),
    charts: series && { robot: series.id, times: series.times.map(iso), columns: series.columns },
  }, null, 1)}\n`;
}

export function save(name, type, text) {
  const address = URL.createObjectURL(new Blob([text], { type }));
  el("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}
