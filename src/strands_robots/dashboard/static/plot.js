// The last 30 seconds of all joints on a canvas, each within its own limits.
const SECONDS = 30;
const TURN = [-Math.PI, Math.PI];

export class Plot {
  constructor(canvas) {
    this.canvas = canvas;
    this.samples = [];
    this.asked = false;
  }

  reset(history) { this.samples = history.slice(); this.ask(); }

  add(at, joints) {
    this.samples.push([at, joints]);
    while (this.samples.length && this.samples[0][0] < at - SECONDS) this.samples.shift();
    this.ask();
  }

  ask() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => { this.asked = false; this.draw(); });
  }

  draw() {
    const canvas = this.canvas;
    const width = canvas.clientWidth, height = canvas.clientHeight, ratio = window.devicePixelRatio || 1;
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio)) { canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio); }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const style = getComputedStyle(canvas);
    pen.strokeStyle = style.getPropertyValue("--line");
    pen.lineWidth = 1;
    for (let second = 0; second <= SECONDS; second += 10) {
      const x = width * second / SECONDS;
      pen.beginPath(); pen.moveTo(x, 0); pen.lineTo(x, height); pen.stroke();
    }
    if (!this.samples.length) return;
    const last = this.samples[this.samples.length - 1];
    const names = [];
    for (const part of Object.keys(last[1])) for (const name of Object.keys(last[1][part])) names.push([part, name]);
    names.slice(0, 12).forEach(([part, name], index) => {
      const [low, high] = (this.limits && this.limits[name]) || TURN;
      pen.strokeStyle = style.getPropertyValue(`--plot-${index % 6}`);
      pen.lineWidth = 1.5;
      pen.setLineDash(index < 6 ? [] : [4, 3]);
      pen.beginPath();
      let begun = false, points = 0;
      for (const [at, joints] of this.samples) {
        const value = joints[part] && joints[part][name];
        if (typeof value !== "number") { begun = false; continue; }
        const x = width * (1 - (last[0] - at) / SECONDS);
        const y = height - 2 - (height - 4) * Math.min(1, Math.max(0, (value - low) / (high - low)));
        if (begun) pen.lineTo(x, y); else pen.moveTo(x, y);
        begun = true;
        points += 1;
        // One sample makes no line: a robot that is idle was read once.
        if (points === 1) { pen.fillStyle = pen.strokeStyle; pen.fillRect(Math.min(x, width - 5), y - 2, 5, 4); }
      }
      pen.stroke();
    });
    pen.setLineDash([]);
  }
}
