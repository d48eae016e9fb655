// One robot: cameras, joints, driving by hand, its verbs and its timeline.
import { el, setAttr, setText } from "./dom.js";
import { ageText, controlText, kindText, lockText, taskText, verdictText, verdictTone } from "./fleet.js";
import { verbForm } from "./forms.js";
import { Jog } from "./jog.js";
import { Plot } from "./plot.js";
import { S } from "./strings.js";
import { Timeline } from "./timeline.js";

const TURN = [-Math.PI, Math.PI];

export class RobotView {
  constructor(fleet, state, onStop) {
    this.fleet = fleet;
    this.state = state;
    this.key = "";
    this.hello = null;
    this.bars = new Map();
    this.title = el("h2", { id: "robot-title" });
    this.kind = el("p", { class: "kind" });
    this.task = el("p", { class: "task" });
    this.lock = el("p", { class: "lock" });
    this.verdict = el("p", { class: "verdict", "data-tone": "quiet" });
    this.age = el("p", { class: "small age" });
    this.stop = el("button", { type: "button", class: "stop-one", text: S.stopOneShort });
    this.stop.addEventListener("click", () => onStop(this.row() ? this.row().id : ""));
    this.stopAlone = el("button", { type: "button", class: "stop-one", text: S.stopAloneShort });
    this.stopAlone.addEventListener("click", () => { const row = this.row(); if (row) onStop(row.id, row.key); });
    this.forget = el("button", { type: "button", class: "plain", text: S.forget, title: S.forgetHint });
    this.forget.addEventListener("click", () => this.state.ask({ type: "forget", key: this.key }));
    this.camera = el("img", { class: "camera", alt: "" });
    this.pose = el("img", { class: "camera", alt: "" });
    this.chosen = el("select", { id: "camera-name" });
    this.chosen.addEventListener("change", () => this.showCamera());
    this.pictures = el("section", { class: "panel pictures", "aria-labelledby": "camera-title" },
      el("div", { class: "tools" }, el("h3", { id: "camera-title", text: S.camera }), el("label", { for: "camera-name", class: "hidden", text: S.cameraWhich }), this.chosen),
      this.camera, this.noCamera = el("p", { class: "small", text: S.noCamera }));
    this.posePanel = el("section", { class: "panel pose", "aria-labelledby": "pose-title" }, el("h3", { id: "pose-title", text: S.pose }), this.pose,
      this.noPose = el("p", { class: "small", role: "status" }));
    this.joints = el("div", { class: "bars" });
    const canvas = el("canvas", { class: "plot", role: "img", "aria-label": S.plot });
    this.plot = new Plot(canvas);
    this.jointsPanel = el("section", { class: "panel joints", "aria-labelledby": "joints-title" }, el("h3", { id: "joints-title", text: S.joints }), this.joints,
      el("h3", { text: S.plot }), canvas);
    this.jogSaid = el("p", { class: "said", role: "status", "aria-live": "polite", text: S.jogHint });
    this.jog = new Jog(state, this.jogSaid);
    this.control = el("p");
    this.take = el("button", { type: "button", text: S.take });
    this.take.addEventListener("click", () => this.toggleControl());
    this.passphrase = el("input", { id: "take-passphrase", type: "password", autocomplete: "off" });
    this.passphraseField = el("div", { class: "field" }, el("label", { for: "take-passphrase", text: S.takePassphrase }), this.passphrase);
    this.speed = el("select", { id: "jog-speed" });
    for (const [value, text] of Object.entries(S.speeds)) this.speed.append(el("option", { value, text }));
    this.speed.value = "0.3";
    this.speed.addEventListener("change", () => { this.jog.speed = Number(this.speed.value); });
    this.pads = el("div", { class: "pads" });
    this.drive = el("section", { class: "panel drive", "aria-labelledby": "drive-title" }, el("h3", { id: "drive-title", text: S.drive }), this.control,
      el("div", { class: "tools" }, this.take, el("label", { for: "jog-speed", text: S.speed }), this.speed), this.passphraseField, this.jogSaid, this.pads);
    this.verbs = el("section", { class: "panel verbs", "aria-labelledby": "verbs-title" });
    this.timeline = new Timeline(fleet);
    this.node = el("div", { id: "robot" },
      el("p", {}, el("a", { href: "#/", text: S.back })),
      el("div", { class: "head" }, el("div", {}, this.title, this.kind, el("div", { class: "now" }, this.task, this.lock, this.verdict, this.age), this.forget), el("div", { class: "stop-own" }, this.stop, this.stopAlone, el("p", { class: "small", text: S.stopOneWhy }))),
      el("div", { class: "columns" }, this.pictures, this.drive, this.posePanel, this.jointsPanel), this.verbs, this.timeline.node);
    state.addEventListener("pose", ({ detail }) => { if (detail.key === this.key) this.showPose(detail.why); });
    state.addEventListener("robot", ({ detail }) => { if (detail.key === this.key) this.details(detail); });
    state.addEventListener("joints", ({ detail }) => { if (detail.key === this.key) this.take_joints(detail); });
  }

  row() { return this.fleet.rows.get(this.key); }

  open(key) {
    if (key === this.key) return;
    this.close();
    this.key = key;
    this.bars.clear();
    this.joints.replaceChildren(el("p", { text: S.noJoints }));
    this.pads.replaceChildren();
    this.verbs.replaceChildren(el("h3", { id: "verbs-title", text: S.verbs }));
    this.signature = this.barKeys = "";
    this.jointNames = this.names = this.limits = null;
    this.resetPictures();
    this.takeRefused = false;
    this.jog.key = key;
    this.jog.axes = [];
    this.watch();
    this.draw();
  }

  watch() { if (this.key) this.state.send({ type: "watch", key: this.key }); }

  // The streams of pictures end with their connection.
  resetPictures() {
    this.cameras = "";
    this.showPose(S.poseComing, true);
  }

  close() {
    this.jog.end("hidden");
    this.key = "";
    // A stream that nobody looks at must end: a browser has six connections to a page.
    for (const image of [this.camera, this.pose]) image.removeAttribute("src");
    this.state.send({ type: "watch", key: "" });
  }

  details(detail) {
    const signature = JSON.stringify([detail.forms, this.hello && this.hello.role]);
    this.plot.limits = this.limits = detail.limits;
    this.plot.reset(detail.history);
    const cameras = JSON.stringify(detail.cameras);
    if (cameras !== this.cameras) { this.cameras = cameras; this.listCameras(detail.cameras); }
    if (signature === this.signature) return;
    this.signature = signature;
    const canMove = this.hello && this.hello.role === "operator";
    this.names = new Set(detail.forms.map((form) => form.name));
    this.verbs.replaceChildren(el("h3", { id: "verbs-title", text: S.verbs }), ...detail.forms.map((form) =>
      verbForm(form, (call) => this.state.ask({ type: "call", key: this.key, ...call }), canMove)));
    this.arrangePads();
  }

  listCameras(names) {
    this.chosen.replaceChildren(...names.map((name) => el("option", { value: name, text: name })));
    const own = names.find((name) => name.includes("/") || name.includes(".")) || names.find((name) => name === "front") || names[0];
    if (own) this.chosen.value = own;
    const none = names.length === 0;
    this.noCamera.hidden = !none;
    for (const node of [this.camera, this.chosen]) node.hidden = none;
    this.showCamera();
    this.ownPose = names.includes("overview");
    if (this.ownPose) this.showPose("");
  }

  // A simulation draws its own; of another arm the page's server draws one from the joint angles that it reports.
  showPose(why, coming = false) {
    this.pose.hidden = why !== "";
    this.noPose.hidden = why === "";
    setText(this.noPose, why && !coming ? S.noPose(why) : why);
    if (why) this.pose.removeAttribute("src");
    else if (!this.pose.getAttribute("src")) this.show(this.pose, "overview", !this.ownPose);
  }

  showCamera() { if (this.chosen.value) this.show(this.camera, this.chosen.value); }

  show(image, camera, drawn = false) {
    if (!this.hello || !this.key) return;
    const id = this.key.slice(this.key.indexOf(":") + 1);
    image.alt = drawn ? S.poseOf(id) : S.pictureOf(id, camera);
    image.src = `camera?${new URLSearchParams({ robot: this.key, camera, ticket: this.hello.ticket, ...(drawn ? { pose: "1" } : {}) })}`;
  }

  take_joints(detail) {
    this.plot.add(detail.at, detail.joints);
    const names = [];
    for (const [part, joints] of Object.entries(detail.joints)) for (const [name, value] of Object.entries(joints)) names.push([part, name, value]);
    const keys = names.map(([part, name]) => `${part}/${name}`).join("\n");
    if (keys !== this.barKeys || this.bars.size === 0) { this.barKeys = keys; this.makeBars(names); }
    for (const [part, name, value] of names) this.bars.get(`${part}/${name}`).show(value, (this.limits && this.limits[name]) || TURN);
    if (!this.jointNames || this.jointNames.join() !== names.map((each) => each[1]).join()) {
      this.jointNames = names.map((each) => each[1]);
      this.arrangePads();
    }
  }

  makeBars(names) {
    this.bars.clear();
    const parts = new Set(names.map((each) => each[0]));
    const nodes = names.map(([part, name], index) => {
      const bar = new Bar(parts.size > 1 ? `${part} ${name}` : name, index);
      this.bars.set(`${part}/${name}`, bar);
      return bar.node;
    });
    this.joints.replaceChildren(...nodes);
  }

  arrangePads() {
    this.jog.axes = [];
    const groups = [], names = this.names || new Set();
    const moving = (this.jointNames || []).filter((name) => name !== "gripper");
    const pair = (kind, axis, [minus, plus], index, name = "") => {
      const [up, down] = index === null ? ["", ""] : this.jog.keysOf(index);
      return el("div", { class: name ? "pair named" : "pair" }, name ? el("span", { text: name }) : null,
        this.jog.button(kind, axis, -1, minus, name ? "\u2212" : minus, down), this.jog.button(kind, axis, 1, plus, name ? "+" : plus, up));
    };
    if (names.has("moveJoints") && moving.length) groups.push(el("fieldset", {}, el("legend", { text: S.jogJoint }), ...moving.slice(0, 10).map((name, index) => pair("joint", name, [S.minus(name), S.plus(name)], index, name))));
    // Hardware has the verbs of an arm, be it one or not; a base tells no joints.
    const arm = moving.length > 0 || !names.has("drive");
    if (arm && names.has("moveBy")) groups.push(el("fieldset", {}, el("legend", { text: S.jogTip }), ...Object.entries(S.tip).map(([axis, ways]) => pair("tip", axis, ways, null))));
    if (arm && names.has("setGripper")) {
      groups.push(el("fieldset", {}, el("legend", { text: S.jogGripper }), el("div", { class: "pair" },
        this.jog.button("gripper", "", -1, S.closeGripper, S.closeGripper, ""), this.jog.button("gripper", "", 1, S.openGripper, S.openGripper, ""))));
    }
    if (names.has("drive")) groups.push(el("fieldset", {}, el("legend", { text: S.jogBase }), pair("base", "linear", S.base.linear, 0), pair("base", "angular", S.base.angular, 1)));
    this.pads.replaceChildren(...groups);
    this.drive.hidden = !names.has("acquireControl") && groups.length === 0;
  }

  async toggleControl() {
    const mine = this.fleet.mine.has(this.key);
    const secret = this.passphrase.value;
    this.passphrase.value = "";
    const answer = await this.state.ask(mine ? { type: "give", key: this.key } : { type: "take", key: this.key, part: "", passphrase: secret });
    this.takeRefused = !mine && !(answer && answer.ok);
    setText(this.jogSaid, answer ? answer.text : S.noAnswer);
    this.jogSaid.dataset.tone = answer && answer.ok ? "good" : "bad";
    this.draw();
  }

  control_changed(detail) {
    if (detail.key === this.key && !detail.held && detail.text) { setText(this.jogSaid, detail.text); this.jogSaid.dataset.tone = "warn"; }
  }

  draw() {
    const row = this.row();
    if (!row) { setText(this.title, this.key.slice(this.key.indexOf(":") + 1)); return; }
    setText(this.title, row.id);
    setAttr(this.stop, "aria-label", S.stopOne(row.id));
    setAttr(this.stop, "title", S.stopOne(row.id));
    setAttr(this.stopAlone, "aria-label", S.stopAlone(row.id));
    setAttr(this.stopAlone, "title", S.stopAlone(row.id));
    setText(this.kind, kindText(row));
    setText(this.task, taskText(row));
    setAttr(this.task, "data-on", this.fleet.moving(row) ? "yes" : "no");
    setText(this.lock, lockText(row) + (row.lockouts.length ? ` · ${S.epoch} ${row.lockouts[0].epoch}` : ""));
    setAttr(this.lock, "data-tone", row.alarm ? "bad" : row.locked === false ? "quiet" : "warn");
    setText(this.verdict, row.stop ? `${S.lastStop}: ${verdictText(row.stop)}` : "");
    setAttr(this.verdict, "data-tone", row.stop ? verdictTone(row.stop) : "quiet");
    const age = this.fleet.age(row);
    setText(this.age, [ageText(this.fleet, row), row.check_in ? S.checkIn(row.check_in.left_s) : ""].filter(Boolean).join(" · "));
    this.forget.hidden = age !== null && age < 6;
    setText(this.control, `${controlText(this.fleet, row)}${row.locked ? `. ${S.lockedHere}` : ""}`);
    const mine = this.fleet.mine.has(this.key), operator = this.hello && this.hello.role === "operator";
    setText(this.take, mine ? S.give : S.take);
    setAttr(this.take, "class", mine ? "" : "primary");
    this.take.disabled = !operator;
    const signable = this.hello && this.hello.operator_key && this.hello.local;
    this.passphraseField.hidden = mine || !signable || !(this.takeRefused || row.control.held);
    this.jog.setEnabled(Boolean(mine && operator && row.locked === false));
    if (!operator && this.hello) setText(this.jogSaid, S.viewer);
    this.timeline.draw(this.key);
  }
}

class Bar {
  constructor(name, index) {
    this.mark = el("span", { class: "mark" });
    this.value = el("span", { class: "value" });
    this.meter = el("div", { class: "track", role: "meter", "aria-label": name }, this.mark);
    this.mark.dataset.color = String(index % 6);
    this.node = el("div", { class: "bar" }, el("span", { class: "joint", text: name }), this.meter, this.value);
  }

  show(value, [low, high]) {
    const share = Math.min(1, Math.max(0, (value - low) / (high - low)));
    this.mark.style.left = `${(share * 100).toFixed(2)}%`;
    setText(this.value, value.toFixed(2));
    for (const [name, number] of [["aria-valuenow", value], ["aria-valuemin", Math.min(low, value)], ["aria-valuemax", Math.max(high, value)]]) setAttr(this.meter, name, number.toFixed(3));
    this.meter.dataset.edge = share < 0.02 || share > 0.98 ? "yes" : "no";
  }
}
