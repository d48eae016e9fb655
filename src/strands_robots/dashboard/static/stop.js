// STOP. The big button and the space bar mean one thing, always: stop every robot. Nothing on this page changes that.
import { el, setText } from "./dom.js";
import { byName, verdictText, verdictTone } from "./fleet.js";
import { S } from "./strings.js";

const ORDER = ["not_stopped", "alarm", "refused", "unknown", "silent", "claimed", "waiting", "stopped", "heard_only"];
const NAMES_MAX = 60;
const CONFIRM_MS = 500;

export class Stop {
  constructor(channel, fleet) {
    this.channel = channel;
    this.fleet = fleet;
    this.link = null;
    this.id = 0;
    this.unconfirmed = new Map();
    this.notSent = "";
    this.silentSince = 0;
    this.button = document.getElementById("stop");
    this.said = document.getElementById("stop-said");
    this.alarm = document.getElementById("alarm");
    setText(document.getElementById("stop-word"), S.stopWord);
    setText(document.getElementById("stop-hint"), S.stopAll);
    document.getElementById("stop-bar").setAttribute("aria-label", S.stopRegion);
    // The press counts, not the release: a finger that slides away has pressed.
    this.button.addEventListener("pointerdown", (event) => { if (event.button === 0) this.press(""); });
    this.button.addEventListener("click", (event) => { if (event.detail === 0) this.press(""); });
    channel.addEventListener("link", ({ detail }) => { this.link = detail; this.look(); });
    channel.addEventListener("lost", () => { this.link = null; this.look(); });
    channel.addEventListener("pressed", ({ detail }) => { this.unconfirmed.delete(detail.id); this.look(); });
    setInterval(() => this.look(), 100);
  }

  // only: the key of the one robot that stops; without it all do.
  press(robot, only) {
    const id = ++this.id;
    if (this.channel.send(only ? { type: "stop", robot, only, id } : { type: "stop", robot, id })) {
      this.notSent = "";
      this.unconfirmed.set(id, performance.now());
    } else {
      this.notSent = `${S.notSent} (${S.when(new Date())})`;
    }
    this.look();
  }

  // What stands between a press and the robots, or "".
  problem() {
    if (this.channel.refused) return S.badToken;
    if (!this.channel.alive) return S.noServer;
    if (!this.link) return S.connecting;
    if (Object.values(this.link.links).some((up) => !up)) return S.noNetwork;
    // The time stands still: a text that counts would be read out again and again.
    if (this.link.can_stop) this.silentSince = 0;
    else this.silentSince = this.silentSince || Date.now() - (this.link.silent_s || 0) * 1000;
    return this.silentSince ? S.silentNetwork(S.when(new Date(this.silentSince))) : "";
  }

  look() {
    if (this.channel.open && this.channel.heardAt && performance.now() - this.channel.heardAt > 3000) this.channel.renew();
    const late = [...this.unconfirmed.values()].some((at) => performance.now() - at > CONFIRM_MS);
    const problem = [this.problem(), this.notSent, late ? S.sentUnconfirmed : ""].filter(Boolean).join(" ");
    setText(this.alarm, problem);
    this.alarm.hidden = problem === "";
    document.body.dataset.canStop = problem === "" ? "yes" : "no";
    const link = document.getElementById("link");
    setText(link, this.channel.alive ? S.connected : this.channel.refused ? S.notAdmitted : S.connecting);
    link.dataset.state = this.channel.alive ? "up" : "down";
    this.draw();
  }

  draw() {
    const answers = [...this.fleet.rows.values()].filter((row) => row.stop).sort((a, b) => byName.compare(a.id, b.id));
    const latest = this.link ? this.link.pressed_at : this.pressedAt;
    this.pressedAt = latest;
    const ready = answers.length === 0 && document.body.dataset.canStop === "yes" ? this.fleet.rows.size : 0;
    const rosters = latest && this.link && !this.link.running ? Object.values(this.link.roster || {}) : [];
    const signature = JSON.stringify([ready, latest, rosters, this.link && this.link.running, answers.map((row) => [row.key, row.stop])]);
    if (signature === this.signature) return;
    this.signature = signature;
    if (!latest && answers.length === 0) { this.said.replaceChildren(...(ready ? [el("p", { "data-tone": "quiet", text: S.ready(ready) })] : [])); return; }
    const groups = new Map(ORDER.map((state) => [state, []]));
    for (const row of answers) (groups.get(row.stop.state) || groups.get("unknown")).push(row);
    const bad = ORDER.slice(0, -2).some((state) => groups.get(state).length) || answers.some((row) => row.stop.alarm) || rosters.some((each) => !each.ok);
    const stopped = groups.get("stopped").length;
    const running = this.link && this.link.running;
    const someFreed = answers.some((row) => row.stop.freed), freed = answers.length > 0 && !bad && !running && answers.every((row) => row.stop.freed);
    const counts = ORDER.filter((state) => groups.get(state).length)
      .map((state) => `${groups.get(state).length} ${S.counts[state]}`).join(", ");
    let summary = counts;
    if (answers.length === 0) summary = running ? S.waitingAnswers : S.noneAnswered;
    else if (freed) summary = S.freedAll(counts);
    else if (!bad && !running && !someFreed) summary = `${S.allStopped(stopped)} ${S.nowLocked}`;
    const head = el("p", { class: "stop-head", "data-tone": bad || answers.length === 0 ? "bad" : running ? "warn" : someFreed ? "quiet" : "good" },
      el("strong", { text: latest ? `${S.pressed(S.when(new Date(latest * 1000)))}: ` : "" }), summary);
    const list = el("ul", { class: "answers" });
    // Once all are free the cards say the rest.
    const worst = freed ? [] : ORDER.flatMap((state) => groups.get(state));
    for (const row of worst.slice(0, NAMES_MAX)) {
      list.append(el("li", { "data-tone": verdictTone(row.stop), "data-state": row.stop.state, "data-key": row.key },
        el("strong", { text: row.id }), ` ${verdictText(row.stop)}`));
    }
    if (worst.length > NAMES_MAX) list.append(el("li", { text: `+ ${worst.length - NAMES_MAX}` }));
    const notes = rosters.flatMap((each) => [each.sentence, ...each.notes]).map((text) => el("p", { class: "small", text }));
    this.said.replaceChildren(head, ...notes, list);
  }
}
