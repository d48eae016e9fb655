// The rows of all robots, and what is said of one.
import { own } from "./dom.js";
import { S } from "./strings.js";

// Made once: a comparison that makes its own collator costs a hundred times as much.
export const byName = new Intl.Collator("en", { numeric: true });
const STALE_S = 3;
const AGAIN_MS = 10000;
const BAD = ["not_stopped", "alarm", "unknown", "refused", "silent"];

export class Fleet {
  constructor() {
    this.rows = new Map();
    this.mine = new Set();
    this.events = [];
    this.now = 0;
    this.nowAt = 0;
    this.version = 0;
    this.again = 0;
  }

  // Another connection, perhaps to a server that has just begun: its rows come one after another, and what was shown
  // keeps its place for so long, with nothing claimed of it.
  begin() {
    this.mine.clear();
    this.events = [];
    this.again = performance.now();
    for (const [key, row] of this.rows) this.rows.set(key, { ...row, heard: null, locked: null, lockouts: [], doubt: "", alarm: false, stop: null, control: {}, task: {}, old: true });
  }

  forgetOld() {
    if (!this.again || performance.now() - this.again < AGAIN_MS) return;
    this.again = 0;
    for (const [key, row] of this.rows) if (row.old) this.rows.delete(key);
  }

  take(message) {
    this.now = message.now;
    this.nowAt = performance.now();
    for (const row of message.rows) this.rows.set(row.key, row);
    for (const key of message.gone) this.rows.delete(key);
    if (message.events.length) this.events = this.events.concat(message.events).slice(-1000);
    this.version += 1;
  }

  // The age grows also while nothing arrives.
  age(row) {
    if (row.heard === null) return null;
    return Math.max(0, this.now + (performance.now() - this.nowAt) / 1000 - row.heard);
  }

  moving(row) { return ["running", "stopping", "starting", "connecting"].includes(row.task.state); }

  stale(row) { const age = this.age(row); return age === null || age > STALE_S; }

  // 0 is the worst.
  attention(row) {
    if ((row.stop && (BAD.includes(row.stop.state) || row.stop.alarm)) || row.alarm) return 0;
    if (row.stop && row.stop.state === "claimed" && !row.stop.freed) return 1;
    if (row.stop && row.stop.state === "waiting") return 1;
    if (row.doubt || row.locked === null) return 2;
    if (this.stale(row)) return 3;
    if (row.locked) return 4;
    return this.moving(row) ? 5 : 6;
  }

  // The worst first.
  sorted(rows) {
    return rows.map((row) => [this.attention(row), row])
      .sort((a, b) => a[0] - b[0] || byName.compare(a[1].id, b[1].id))
      .map((pair) => pair[1]);
  }
}

export function verdictText(stop) {
  let text = S.verdict[stop.state] || S.verdict.unknown;
  if (stop.settling) text += S.settling;
  if (stop.ms !== null && stop.ms !== undefined && ["stopped", "claimed"].includes(stop.state)) text += S.inMs(stop.ms);
  if (stop.state === "stopped") text += ` (${stop.signed ? S.signed : S.unsigned})`;
  if (stop.state === "claimed") text += S.unproven;
  if (stop.why) text += `: ${stop.why}`;
  if (stop.alarm) text += `. ALARM: ${stop.alarm}`;
  if (stop.freed) text += S.freed;
  return text;
}

export function verdictTone(stop) {
  if (stop.alarm) return "bad";
  // It says nothing about the present any more, so it is not green.
  if (stop.freed && ["stopped", "claimed"].includes(stop.state)) return "quiet";
  return { stopped: "good", claimed: "warn", waiting: "warn", heard_only: "quiet" }[stop.state] || "bad";
}

// Two robots of one id are told apart by their networks.
export function nameText(row) { return row.namesake ? `${row.id} (${S.network[row.network] || row.network})` : row.id; }

export function lockText(row) {
  if (row.lacking && row.locked === null) return row.lacking;
  if (row.locked === null) return `${S.lockUnknown}${row.doubt ? `: ${row.doubt}` : ""}`;
  if (!row.locked) return S.free;
  const first = row.lockouts[0];
  if (!first) return S.locked;
  const at = typeof first.since === "number" ? S.when(new Date(first.since * 1000)) : "";
  const why = `${first.scope ? ` (${first.scope})` : ""}${first.reason ? `: ${first.reason}` : ""}`;
  return `${S.lockedBy(first.source, at)}${why}${row.lockouts.length > 1 ? ` (×${row.lockouts.length})` : ""}`;
}

export function kindText(row) {
  return [row.model, own(S.kinds, row.kind) || row.kind, S.network[row.network] || row.network].filter(Boolean).join(" · ");
}

export function taskText(row) {
  const task = row.task;
  // A recorder that waits tells how far it is.
  if (!task.state || task.state === "idle") return row.kind === "recorder" && task.instruction ? task.instruction : S.idle;
  const step = typeof task.step === "number" && ["running"].includes(task.state) ? `, ${S.step(task.step)}` : "";
  return `${task.state}${task.instruction ? `: ${task.instruction}` : ""}${step}`;
}

export function ageText(fleet, row) {
  const age = fleet.age(row);
  if (age === null) return S.neverHeard;
  const link = row.link_ms === null ? "" : ` · ${S.roundTrip(row.link_ms)}`;
  return `${age < 1 ? S.heardNow : S.heard(Math.floor(age))}${link}`;
}

export function controlText(fleet, row) {
  if (fleet.mine.has(row.key)) return S.heldHere;
  return row.control.held ? S.heldBy(row.control.holder, row.control.kind) : row.lacking ? "" : S.notHeld;
}
