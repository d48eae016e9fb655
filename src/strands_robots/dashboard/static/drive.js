// Driving by hand: who has control, what is said of it, and the pads, each at a place that it keeps.
import { el, setAttr, setText, setShown } from "./dom.js";
import { controlText } from "./fleet.js";
import { Jog } from "./jog.js";
import { S } from "./strings.js";
import { Turns } from "./turns.js";

export class Drive {
  constructor(fleet, state, pictures) {
    this.fleet = fleet;
    this.state = state;
    this.key = "";
    this.hello = null;
    this.groups = new Map();
    this.said = el("p", { class: "said", role: "status", "aria-live": "polite", tabindex: 0, "aria-label": S.driveSaid, text: S.jogHint });
    this.jog = new Jog(state, this.said);
    this.turns = new Turns(state, pictures);
    this.control = el("p", { class: "control" });
    this.take = el("button", { type: "button", class: "take", text: S.take });
    this.take.addEventListener("click", () => this.toggleControl());
    this.passphrase = el("input", { id: "take-passphrase", type: "password", autocomplete: "off" });
    this.passphraseField = el("div", { class: "field" }, el("label", { for: "take-passphrase", text: S.takePassphrase }), this.passphrase);
    this.speed = el("select", { id: "jog-speed" });
    for (const [value, text] of Object.entries(S.speeds)) this.speed.append(el("option", { value, text }));
    this.speed.value = "0.3";
    this.speed.addEventListener("change", () => { this.jog.speed = Number(this.speed.value); });
    this.pads = el("div", { class: "pads" });
    this.title = el("h3", { id: "drive-title", text: S.drive });
    this.speedLabel = el("label", { for: "jog-speed", text: S.speed });
    this.node = el("section", { class: "panel drive", "aria-labelledby": "drive-title" }, this.title, this.control,
      el("div", { class: "tools" }, this.take, this.speedLabel, this.speed), this.passphraseField, this.said, this.turns.node, this.pads);
  }

  open(key) {
    this.close();
    this.jog.key = this.key = key;
    this.turns.open(key);
    this.jog.axes = [];
    this.groups.clear();
    this.pads.replaceChildren();
    this.jointNames = this.names = null;
    this.holdable = false;
    this.say(S.jogHint, "quiet");
  }

  // Keys and sticks move nothing that is not seen; draw() enables them again.
  close() {
    this.jog.end("hidden");
    this.turns.close();
    this.jog.setEnabled(false);
  }

  say(text, tone) {
    setText(this.said, text);
    setAttr(this.said, "data-tone", tone);
  }

  details(detail) {
    this.names = new Set(detail.forms.map((form) => form.name));
    this.holdable = detail.holdable;
    this.turns.details(detail);
    if (detail.history.length) this.take_joints(detail.history[detail.history.length - 1][1]);
    this.arrange();
  }

  take_joints(joints) {
    const names = Object.values(joints).flatMap((own) => Object.keys(own));
    if (this.jointNames && this.jointNames.join("\n") === names.join("\n")) return;
    this.jointNames = names;
    this.arrange();
  }

  // A group that is there keeps its place; one that a robot tells of later comes after the others.
  arrange() {
    const names = this.names || new Set(), wanted = new Map();
    const moving = (this.jointNames || []).filter((name) => !/^gripper(\.pos)?$/.test(name)).slice(0, 10);
    if (names.has("moveJoints") && moving.length) wanted.set(`joints ${moving.join()}`, () => [S.jogJoint, moving.map((name, index) => this.pair("joint", name, [S.minus(plain(name)), S.plus(plain(name))], index, plain(name)))]);
    // Hardware has the verbs of an arm, be it one or not; a base tells no joints.
    const arm = moving.length > 0 || !names.has("drive");
    if (arm && names.has("moveBy")) wanted.set("tip", () => [S.jogTip, Object.entries(S.tip).map(([axis, ways]) => this.pair("tip", axis, ways, null))]);
    if (arm && names.has("setGripper")) wanted.set("gripper", () => [S.jogGripper, [this.pair("gripper", "", [S.closeGripper, S.openGripper], null)]]);
    if (names.has("drive")) wanted.set("base", () => [S.jogBase, [this.pair("base", "linear", S.base.linear, 0), this.pair("base", "angular", S.base.angular, 1)]]);
    const ofJoints = (id) => id.startsWith("joints "), joints = [...wanted.keys()].find(ofJoints);
    for (const [id, group] of this.groups) if (!wanted.has(id) && !(joints && ofJoints(id))) { group.node.remove(); this.groups.delete(id); }
    for (const [id, make] of wanted) {
      if (this.groups.has(id)) continue;
      this.jog.axes = [];
      const [title, pairs] = make();
      const group = { node: el("fieldset", {}, el("legend", { text: title }), ...pairs), axes: this.jog.axes };
      const old = ofJoints(id) ? [...this.groups.keys()].find(ofJoints) : undefined;
      if (old === undefined) {
        this.groups.set(id, group);
        this.pads.append(group.node);
      } else {
        // Other joints of the same robot take the place of those before.
        this.groups.get(old).node.replaceWith(group.node);
        this.groups = new Map([...this.groups].map(([each, own]) => each === old ? [id, group] : [each, own]));
      }
    }
    // Nobody can let go of a button that is gone.
    if (this.jog.now && this.jog.now.node && !this.jog.now.node.isConnected) this.jog.end("released");
    this.jog.axes = [...this.groups.values()].flatMap((group) => group.axes);
    this.node.hidden = !this.holdable && wanted.size === 0;
    // Without anything to jog a robot is moved by its verbs alone.
    this.speed.hidden = this.speedLabel.hidden = wanted.size === 0;
    setText(this.title, wanted.size ? S.drive : S.control);
    if (this.said.textContent === S.jogHint && !wanted.size) this.say(S.verbHint, "quiet");
    if (this.said.textContent === S.verbHint && wanted.size) this.say(S.jogHint, "quiet");
  }

  pair(kind, axis, [minus, plus], index, name = "") {
    const [up, down] = index === null ? ["", ""] : this.jog.keysOf(index);
    return el("div", { class: name ? "pair named" : "pair" }, name ? el("span", { text: name, title: name }) : null,
      this.jog.button(kind, axis, -1, minus, name ? "\u2212" : minus, down), this.jog.button(kind, axis, 1, plus, name ? "+" : plus, up));
  }

  async toggleControl() {
    const mine = this.fleet.mine.has(this.key), key = this.key;
    const secret = this.passphrase.value;
    this.passphrase.value = "";
    const answer = await this.state.ask(mine ? { type: "give", key } : { type: "take", key, part: "", passphrase: secret });
    if (key !== this.key) return;
    this.say(answer ? answer.text : S.noAnswer, answer && answer.ok ? "good" : "bad");
    this.draw(this.fleet.rows.get(key));
  }

  control_changed(detail) {
    if (detail.key === this.key && !detail.held && detail.text) this.say(detail.text, "warn");
  }

  draw(row) {
    if (!row) return;
    setText(this.control, `${controlText(this.fleet, row)}${row.locked ? `. ${S.lockedHere}` : ""}`);
    const mine = this.fleet.mine.has(this.key), operator = this.hello && this.hello.role === "operator";
    setText(this.take, mine ? S.give : S.take);
    setAttr(this.take, "class", mine ? "take" : "take primary");
    this.take.disabled = !operator;
    const signable = this.hello && this.hello.operator_key && this.hello.local;
    this.passphraseField.hidden = !signable;
    setShown(this.passphraseField, !mine);
    const may = Boolean(mine && operator && row.locked === false);
    this.jog.setEnabled(may);
    this.turns.draw(may, row);
    if (!operator && this.hello) setText(this.said, S.viewer);
  }
}

// A joint of LeRobot is named by its action key; what is shown is the joint.
const plain = (name) => name.replace(/\.pos$/, "");
