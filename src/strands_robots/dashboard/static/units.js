// Positions in the unit that the verbs take: degrees for an angle.
import { own } from "./dom.js";

const DEGREES = 180 / Math.PI;
const UNITS = {
  radians: { text: "\u00b0", factor: DEGREES, digits: 1 },
  degrees: { text: "\u00b0", factor: 1, digits: 1 },
  metres: { text: "mm", factor: 1000, digits: 0 },
  percent: { text: "%", factor: 1, digits: 0 },
  normalized: { text: "% of half its range", factor: 1, digits: 0 },
};
const NONE = { text: "", factor: 1, digits: 2 };

export const unitOf = (units, name) => own(UNITS, own(units, name)) || NONE;

export function shownIn(unit, value) {
  const number = (value * unit.factor).toFixed(unit.digits).replace(/^-(?=[0.]+$)/, "");
  return `${number}${unit.text === "\u00b0" ? "\u00b0" : unit.text ? `\u00a0${unit.text.slice(0, 2).trim()}` : ""}`;
}

// Where a robot tells no limits: a turn of a joint that is told as an angle, else what is seen.
export function limitsOf(limits, units, name) {
  const told = own(limits, name), unit = own(units, name);
  if (told) return told;
  if (unit === "degrees") return [-180, 180];
  if (unit === "percent") return [0, 100];
  if (unit === "normalized") return [-100, 100];
  return [-Math.PI, Math.PI];
}
