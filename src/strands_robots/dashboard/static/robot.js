// One robot: cameras, joints, driving by hand, its verbs and its timeline.
import { el, setAttr, setLine, setShown, setText } from "./dom.js";
import { Drive } from "./drive.js";
import { ageText, kindText, lockText, nameText, taskText, verdictText, verdictTone } from "./fleet.js";
import { STOPS } from "./forms.js";
import { Halt } from "./halt.js";
import { Joints } from "./joints.js";
import { Pictures } from "./pictures.js";
import { Recorder, isRecorder } from "./recorder.js";
import { S } from "./strings.js";
import { Timeline } from "./timeline.js";
import { Verbs } from "./verbs.js";

// The parts are shown together, once the robot has said what it has; one that says nothing is waited for so long.
const READY_MS = 2000;
const OF_JOINTS = ["getPose", "moveJoints", "execute", "start"];

export class RobotView {
  constructor(fleet, state, onStop) {
    this.fleet = fleet;
    this.state = state;
    this.key = "";
    this.title = el("h2", { id: "robot-title" });
    this.kind = el("p", { class: "kind" });
    this.task = el("p", { class: "task" });
    this.lock = el("p", { class: "lock" });
    this.verdict = el("p", { class: "verdict", "data-tone": "quiet" });
    this.age = el("p", { class: "small age" });
    this.halt = new Halt(state);
    this.stop = el("button", { type: "button", class: "stop-one", text: S.stopOneShort });
    this.stop.addEventListener("click", () => onStop(this.row() ? this.row().id : ""));
    this.stopAlone = el("button", { type: "button", class: "stop-one", text: S.stopAloneShort });
    this.stopAlone.addEventListener("click", () => { const row = this.row(); if (row) onStop(row.id, row.key); });
    this.stopCell = el("button", { type: "button", class: "stop-one stop-cell", text: S.stopCellShort });
    this.stopCell.addEventListener("click", () => { const row = this.row(); if (row) onStop(row.id, null, row.cell); });
    this.stopWhy = el("p", { class: "small", text: S.stopOneWhy });
    this.forget = el("button", { type: "button", class: "plain forget", text: S.forget, title: S.forgetHint });
    this.forget.addEventListener("click", () => this.state.ask({ type: "forget", key: this.key }));
    this.pictures = new Pictures();
    this.joints = new Joints();
    this.drive = new Drive(fleet, state, this.pictures);
    this.verbs = new Verbs(state);
    this.recorder = new Recorder(state);
    this.timeline = new Timeline(fleet);
    this.opening = el("p", { class: "small opening", role: "status" });
    this.columns = el("div", { class: "columns" }, this.pictures.node, this.drive.node, this.pictures.poseNode, this.joints.node);
    this.parts = el("div", { class: "parts" }, this.recorder.node, this.columns, this.timeline.node, this.verbs.node);
    this.node = el("div", { id: "robot" },
      el("div", { class: "back" }, el("a", { href: "#/", text: S.back }), this.forget),
      el("div", { class: "about" },
        el("div", { class: "head" }, el("div", { class: "who" }, this.title, this.kind), this.halt.button),
        this.halt.said,
        el("div", { class: "now", role: "group", "aria-label": S.state, tabindex: 0 }, this.task, this.lock, this.age, this.verdict),
        el("div", { class: "stop-own" }, this.stop, this.stopCell, this.stopAlone, this.stopWhy)),
      this.opening, this.parts);
    state.addEventListener("pose", ({ detail }) => { if (detail.key === this.key) this.pictures.showPose(detail.why); });
    state.addEventListener("robot", ({ detail }) => { if (detail.key === this.key) this.details(detail); });
    state.addEventListener("picture", ({ detail }) => this.ledPicture(detail));
    state.addEventListener("joints", ({ detail }) => {
      if (detail.key !== this.key) return;
      setAttr(this.columns, "data-joints", "yes");
      this.joints.take(detail);
      this.drive.take_joints(detail.joints);
    });
  }

  set hello(hello) { for (const part of [this.pictures, this.drive, this.verbs, this.recorder]) part.hello = hello; }

  row() { return this.fleet.rows.get(this.key); }

  open(key) {
    if (key === this.key) return;
    this.close();
    this.key = key;
    this.placed = false;
    this.records = false;
    setAttr(this.columns, "data-joints", "yes");
    for (const part of [this.pictures, this.joints, this.drive, this.verbs]) part.open(key);
    this.record();
    this.ready(false);
    this.waiting = setTimeout(() => this.ready(true), READY_MS);
    this.watch();
    this.draw();
  }

  // A robot may call itself a recorder: it is one by its verbs as well.
  get ofRecording() { return this.records && isRecorder(this.row()); }

  // A recorder has buttons of its own, and nothing to drive.
  record() {
    const recorder = this.ofRecording;
    this.recorder.open(this.key, recorder);
    this.columns.hidden = recorder;
    setText(this.stopWhy, recorder ? S.recorder.stops : S.stopOneWhy);
    this.recording = recorder;
  }

  ready(shown) {
    clearTimeout(this.waiting);
    this.parts.hidden = !shown;
    this.opening.hidden = shown;
    setText(this.opening, shown ? "" : S.opening);
    if (shown) this.joints.plot.ask();
  }

  watch() { if (this.key) this.state.send({ type: "watch", key: this.key }); }

  ledPicture({ head, jpeg }) {
    const [, number, key] = head.match(/^led:(\d+):(.*)$/) || [];
    if (key && key === this.key) this.pictures.ledPicture(jpeg, () => this.state.send({ type: "seen", key, number: Number(number) }));
  }

  resetPictures() { this.pictures.reset(); }

  close() {
    this.drive.close();
    this.pictures.close();
    this.recorder.close();
    this.key = "";
    this.state.send({ type: "watch", key: "" });
  }

  details(detail) {
    for (const part of [this.pictures, this.joints, this.drive, this.verbs]) part.details(detail);
    this.records = detail.forms.some((form) => form.name === "getRecording");
    if (this.ofRecording !== this.recording) this.record();
    const joints = hasJoints(detail);
    if (joints) setAttr(this.columns, "data-joints", "yes");
    if (!detail.looked || !this.parts.hidden) return;
    const camera = detail.cameras.length || detail.forms.some((form) => form.name === "getPicture");
    setAttr(this.columns, "data-camera", camera ? "yes" : "no");
    setAttr(this.columns, "data-joints", joints ? "yes" : "no");
    this.ready(true);
    this.draw();
  }

  control_changed(detail) { this.drive.control_changed(detail); }

  draw() {
    const row = this.row();
    if (!row) { setLine(this.title, this.key.slice(this.key.indexOf(":") + 1)); return; }
    if (this.ofRecording !== this.recording) this.record();
    this.halt.of(row);
    setLine(this.title, nameText(row));
    setLine(this.kind, kindText(row));
    for (const [button, says] of [[this.stop, S.stopOne(row.id)], [this.stopAlone, S.stopAlone(row.id) + (row.namesake ? ` ${S.alsoNamesakes}` : "")]]) {
      setAttr(button, "aria-label", says);
      setAttr(button, "title", says);
    }
    // The button has its place from the first look on, where the robot is in a cell.
    if (!this.placed) { this.placed = true; this.stopCell.hidden = !row.cell; }
    setShown(this.stopCell, Boolean(row.cell));
    setAttr(this.stopCell, "aria-label", S.stopCell(row.cell));
    setAttr(this.stopCell, "title", S.stopCell(row.cell));
    setLine(this.task, taskText(row));
    setAttr(this.task, "data-on", this.fleet.moving(row) ? "yes" : "no");
    setLine(this.lock, lockText(row) + (row.lockouts.length ? ` \u00b7 ${S.epoch} ${row.lockouts[0].epoch.slice(0, 8)}` : ""));
    setAttr(this.lock, "data-tone", row.alarm ? "bad" : row.locked === false ? "quiet" : "warn");
    setText(this.verdict, row.stop ? `${S.lastStop}: ${verdictText(row.stop)}` : "");
    setAttr(this.verdict, "data-tone", row.stop ? verdictTone(row.stop) : "quiet");
    const age = this.fleet.age(row);
    setLine(this.age, [ageText(this.fleet, row), row.check_in ? S.checkIn(row.check_in.left_s) : ""].filter(Boolean).join(" \u00b7 "));
    setShown(this.forget, age === null || age >= 6);
    this.drive.draw(row);
    this.timeline.draw(this.key);
  }
}

// A robot that can do only what is its own has no joints, unless it tells some. Of a device of others all is its own.
const hasJoints = ({ forms, history, limits, units }) => !forms.length || history.length > 0 || Object.keys({ ...limits, ...units }).length > 0 ||
  forms.some((form) => OF_JOINTS.includes(form.name) || (form.kind !== "read" && !form.own && !STOPS.includes(form.name)));
