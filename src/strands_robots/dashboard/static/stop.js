// STOP. The big button and the space bar mean one thing, always: stop every robot. Nothing on this page changes that.
import { el, setAttr, setText } from "./dom.js";
import { byName, nameText, verdictText, verdictTone } from "./fleet.js";
import { S } from "./strings.js";

const ORDER = ["not_stopped", "alarm", "refused", "unknown", "silent", "claimed", "waiting", "stopped", "heard_only"];
const NAMES_MAX = 200, NAMED_MAX = 4;
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
    this.items = new Map();
    this.button = document.getElementById("stop");
    this.said = document.getElementById("stop-said");
    this.alarm = document.getElementById("alarm");
    this.missing = document.getElementById("missing");
    this.head = el("p", { class: "stop-head", "data-tone": "quiet", tabindex: 0 });
    this.list = el("ul", { class: "answers" });
    this.notes = el("div");
    this.said.setAttribute("aria-label", S.stopAnswers);
    this.said.append(this.head, this.list, this.notes);
    // The press counts, not the release: a finger that slides away has pressed.
    this.button.addEventListener("pointerdown", (event) => { if (event.button === 0) this.press(""); });
    this.button.addEventListener("click", (event) => { if (event.detail === 0) this.press(""); });
    channel.addEventListener("link", ({ detail }) => { this.link = detail; this.look(); });
    channel.addEventListener("lost", () => { this.link = null; this.look(); });
    channel.addEventListener("pressed", ({ detail }) => { this.unconfirmed.delete(detail.id); this.look(); });
    setInterval(() => this.look(), 100);
  }

  // only: the key of the one robot that stops; cell: the cell that does; without either all do.
  press(robot, only, cell) {
    const id = ++this.id;
    if (this.channel.send({ type: "stop", robot, id, ...(only ? { only } : {}), ...(cell ? { cell } : {}) })) {
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
    const links = Object.entries(this.link.links), down = links.filter(([, up]) => !up).map(([name]) => S.network[name] || name);
    if (down.length === links.length) return [S.noNetwork, this.gone()].filter(Boolean).join(" ");
    // The time stands still: a text that counts would be read out again and again.
    this.silentSince = this.link.silent ? this.silentSince || Date.now() - this.link.silent_s * 1000 : 0;
    // A link that is up may lead to no robot.
    const silent = this.silentSince ? S.silentNetwork(S.when(new Date(this.silentSince))) : "";
    return [silent, ...(down.length ? [S.noAnswerOf(down.join(", ")), this.gone()] : [])].filter(Boolean).join(" ");
  }

  // The networks that the server could not join, with the reasons.
  gone() { return this.link ? Object.entries(this.link.missing).map(([name, why]) => S.networkMissing(S.network[name] || name, why)).join(" ") : ""; }

  look() {
    this.channel.renewIfSilent(3000);
    const late = [...this.unconfirmed.values()].some((at) => performance.now() - at > CONFIRM_MS);
    const problem = [this.problem(), this.notSent, late ? S.sentUnconfirmed : ""].filter(Boolean).join(" ");
    setText(this.alarm, problem);
    this.alarm.hidden = problem === "";
    setText(this.missing, problem ? "" : this.gone());
    this.missing.hidden = this.missing.textContent === "";
    document.body.dataset.canStop = problem === "" ? "yes" : "no";
    const link = document.getElementById("link");
    setText(link, this.channel.alive ? S.connected : this.channel.refused ? S.notAdmitted : S.connecting);
    link.dataset.state = this.channel.alive ? "up" : "down";
    this.draw();
  }

  draw() {
    const answers = [...this.fleet.rows.values()].filter((row) => row.stop);
    const latest = this.link ? this.link.pressed_at : this.pressedAt;
    this.pressedAt = latest;
    const ready = answers.length === 0 && document.body.dataset.canStop === "yes" ? this.fleet.rows.size : 0;
    const rosters = latest && this.link && !this.link.running ? Object.entries(this.link.roster) : [];
    this.pressedFor = this.link ? this.link.pressed_for : this.pressedFor;
    const signature = JSON.stringify([ready, latest, this.pressedFor, rosters, this.link && this.link.running, answers.map((row) => [row.key, row.stop, row.namesake])]);
    if (signature === this.signature) return;
    this.signature = signature;
    const groups = new Map(ORDER.map((state) => [state, []]));
    for (const row of answers) (groups.get(row.stop.state) || groups.get("unknown")).push(row);
    const bad = ORDER.slice(0, -2).some((state) => groups.get(state).length) || answers.some((row) => row.stop.alarm) || rosters.some(([, each]) => !each.ok);
    const running = this.link && this.link.running;
    const someFreed = answers.some((row) => row.stop.freed), freed = answers.length > 0 && !bad && !running && answers.every((row) => row.stop.freed);
    const counts = ORDER.filter((state) => groups.get(state).length).map((state) => count(state, groups.get(state))).join(", ");
    let summary = counts;
    if (!latest && answers.length === 0) summary = ready ? S.ready(ready) : "";
    else if (answers.length === 0) summary = running ? S.waitingAnswers : S.noneAnswered;
    else if (freed) summary = S.freedAll(counts);
    else if (!bad && !running && !someFreed) summary = `${S.allStopped(groups.get("stopped").length)} ${S.nowLocked}`;
    const tone = !latest && answers.length === 0 ? "quiet" : bad || answers.length === 0 ? "bad" : running ? "warn" : someFreed ? "quiet" : "good";
    setAttr(this.head, "data-tone", tone);
    this.head.replaceChildren(el("strong", { text: latest ? `${S.pressed(S.when(new Date(latest * 1000)), this.pressedFor)}: ` : "" }), summary);
    // Once all are free the cards say the rest.
    this.drawAnswers(freed ? [] : ORDER.flatMap((state) => groups.get(state)).slice(0, NAMES_MAX));
    // What is true of every network is said once.
    const said = rosters.flatMap(([name, each]) => [rosters.length > 1 ? `${S.network[name] || name}: ${each.sentence}` : each.sentence, ...each.notes]);
    const notes = el("div", {}, ...[...new Set(said)].map((text) => el("p", { class: "small", text })));
    this.notes.replaceWith(notes);
    this.notes = notes;
  }

  // Each robot keeps its place while the answers come: by name, and the summary names those that did not stop.
  drawAnswers(rows) {
    const wanted = new Set(rows.map((row) => row.key));
    for (const [key, item] of this.items) if (!wanted.has(key)) { item.node.remove(); this.items.delete(key); }
    let at = this.list.firstChild;
    for (const row of rows.sort((a, b) => byName.compare(a.id, b.id))) {
      let item = this.items.get(row.key);
      if (!item) {
        const words = el("span"), name = el("strong");
        item = { words, name, node: el("li", { "data-key": row.key }, name, " ", words) };
        this.items.set(row.key, item);
      }
      if (item.node === at) at = at.nextSibling; else this.list.insertBefore(item.node, at);
      const text = verdictText(row.stop);
      setAttr(item.node, "data-tone", verdictTone(row.stop));
      setAttr(item.node, "data-state", row.stop.state);
      setAttr(item.node, "title", `${nameText(row)} ${text}`);
      setText(item.name, nameText(row));
      setText(item.words, text);
    }
  }
}

function count(state, rows) {
  const text = `${rows.length} ${S.counts[state]}`;
  if (["stopped", "heard_only", "waiting"].includes(state)) return text;
  const names = rows.map(nameText).sort(byName.compare);
  return `${text}: ${names.slice(0, NAMED_MAX).join(", ")}${names.length > NAMED_MAX ? " ..." : ""}`;
}
