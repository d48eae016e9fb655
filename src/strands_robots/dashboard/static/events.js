// Events in words: names as one says them, times as a clock shows them, and nothing that only a program reads.
import { own } from "./dom.js";
import { S } from "./strings.js";

const TIME = /^(t|at|ts|since|until|issued|time|timestamp)$|_at$/;
const LEFT_OUT = /^(epoch|estop_id|id|n|nonce|loop|robot_name|seq|statement|signature|key_id|boot_id)$/;
const EARLIEST = 1e9, LATEST = 4e9;
const CODE = /^[0-9a-f]{16,}$/i;

export const labelOf = (name) => own(S.labels, name) ||
  name.replace(/_(mm|ms|hz|deg)$/, ", $1").replace(/_s$/, ", s").replace(/([a-z\d])([A-Z])(?=[a-z])/g, (_, before, letter) => `${before} ${letter.toLowerCase()}`).replace(/_/g, " ").replace(/^[A-Z](?=[a-z])/, (letter) => letter.toLowerCase());

export function textOf(name, value) {
  if (value === true) return S.yes;
  if (value === false) return S.no;
  if (value === null || value === undefined || value === "") return "\u2013";
  if (typeof value !== "number") return String(value);
  if (TIME.test(name) && value > EARLIEST && value < LATEST) return S.when(new Date(value * 1000));
  return Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(4)));
}

// A fact is a number, a text, or an object that was cut to a text.
function unpacked(value) {
  if (typeof value !== "string" || !/^[[{]/.test(value)) return value;
  try { return JSON.parse(value); } catch { return value; }
}

function factText(name, given) {
  const value = unpacked(given);
  if (Array.isArray(value)) return value.length ? value.map((each) => typeof each === "object" ? JSON.stringify(each) : textOf(name, each)).join(", ") : "";
  if (value !== null && typeof value === "object") return Object.entries(value).map(([each, own]) => `${labelOf(each)} ${typeof own === "object" ? JSON.stringify(own) : textOf(each, own)}`).join(", ");
  return value === "" || value === null || (typeof value === "string" && CODE.test(value)) ? "" : textOf(name, value);
}

export const eventText = (event) => own(S.events, event) || labelOf(event);

export function factsText(each) {
  return Object.entries(each.facts)
    .filter(([name, value]) => !LEFT_OUT.test(name) && !(["robot", "device", "robots", "devices"].includes(name) && [each.robot, `["${each.robot}"]`].includes(value)))
    .map(([name, value]) => [name, factText(name, value)])
    .filter(([, text]) => text !== "")
    .map(([name, text]) => `${labelOf(name)}: ${text}`).join(" \u00b7 ");
}
