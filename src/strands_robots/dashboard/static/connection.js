// Two WebSockets: one carries state, the other nothing but STOP and the proof that STOP would work.
const SILENT_MS = 700;
const AGAIN_MS = 400;
const CONNECTING_MS = 10_000;

const fragment = new URLSearchParams(location.hash.slice(1));
if (fragment.get("token")) {
  sessionStorage.setItem("token", fragment.get("token"));
  history.replaceState(null, "", location.pathname);
}
const token = () => sessionStorage.getItem("token") || "";
const address = (path) => `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path}`;

// A picture has a head of its own: its robot's key, or the number of a picture by which this page leads.
function pictureOf(data) {
  const length = new DataView(data).getUint16(0);
  return { type: "picture", head: new TextDecoder().decode(new Uint8Array(data, 2, length)), jpeg: new Uint8Array(data, 2 + length) };
}

export class Channel extends EventTarget {
  constructor(path) {
    super();
    this.path = path;
    this.refused = false;
    this.heardAt = this.openedAt = 0;
    this.connect();
  }

  get open() { return this.socket.readyState === WebSocket.OPEN; }

  connect() {
    const socket = this.socket = new WebSocket(address(this.path));
    this.beganAt = performance.now();
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      if (socket === this.socket) this.openedAt = performance.now();
      socket.send(JSON.stringify({ type: "hello", token: token() }));
    };
    socket.onmessage = (event) => {
      if (socket !== this.socket) return;
      this.heardAt = performance.now();
      const data = typeof event.data === "string" ? JSON.parse(event.data) : pictureOf(event.data);
      this.dispatchEvent(new CustomEvent(data.type, { detail: data }));
    };
    socket.onclose = (event) => {
      if (socket !== this.socket) return;
      this.refused = event.code === 4401;
      this.dispatchEvent(new CustomEvent("lost"));
      setTimeout(() => { if (socket === this.socket) this.connect(); }, this.refused ? 5000 : AGAIN_MS);
    };
  }

  send(message) {
    if (!this.open) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  // True while the server has been heard a moment ago; a server that hangs keeps its socket open.
  get alive() { return this.open && performance.now() - this.heardAt < SILENT_MS; }

  // A new socket has as long for its first word as an old one between two.
  get silentMs() { return performance.now() - Math.max(this.heardAt, this.openedAt); }

  // A socket that is open and says nothing for so long is given up for a new one; so is one that does not open.
  renewIfSilent(longestMs) {
    const connecting = this.socket.readyState === WebSocket.CONNECTING;
    if (this.open ? this.silentMs > longestMs : connecting && performance.now() - this.beganAt > CONNECTING_MS) this.renew();
  }

  // The close of the old socket may come late or never, so what waits for an answer is told here. The new socket is
  // there before: who is told may look at the channel.
  renew() {
    const old = this.socket;
    this.connect();
    this.dispatchEvent(new CustomEvent("lost"));
    old.close();
  }
}

export class State extends Channel {
  constructor() {
    super("/state");
    this.number = 0;
    this.waiting = new Map();
    this.addEventListener("answer", ({ detail }) => {
      const done = this.waiting.get(detail.id);
      this.waiting.delete(detail.id);
      if (done) done(detail);
    });
    this.addEventListener("lost", () => {
      for (const done of this.waiting.values()) done(null);
      this.waiting.clear();
    });
  }

  // Resolves with the answer, or with null when the page was disconnected.
  ask(message) {
    const id = ++this.number;
    return new Promise((resolve) => {
      if (!this.send({ ...message, id })) { resolve(null); return; }
      this.waiting.set(id, resolve);
    });
  }
}
