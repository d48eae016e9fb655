import { CamerasView } from "./cameras.js";
import { FleetView } from "./cards.js";
import { Channel, State } from "./connection.js";
import { keepsSpace, setText, typing } from "./dom.js";
import { Fleet } from "./fleet.js";
import { HistoryView } from "./history.js";
import { Resume } from "./resume.js";
import { RobotView } from "./robot.js";
import { Stop } from "./stop.js";
import { S } from "./strings.js";

const fleet = new Fleet();
// The way of STOP is opened first.
const channel = new Channel("/stop");
const stop = new Stop(channel, fleet);
const state = new State();
const view = new FleetView(fleet, state, (id) => stop.press(id));
const robot = new RobotView(fleet, state, (id, only, cell) => stop.press(id, only, cell));
const history = new HistoryView(fleet, state);
const cameras = new CamerasView(fleet, state);
const others = { "#/history": history, "#/cameras": cameras };
const resume = new Resume(fleet, state);
const views = document.getElementById("views");
const main = document.getElementById("main");

// Space is STOP, wherever the focus is but in a text, on a list or on a link, whose own key it is.
window.addEventListener("keydown", (event) => {
  if (event.code !== "Space" || event.ctrlKey || event.altKey || event.metaKey || keepsSpace(event.target)) return;
  event.preventDefault();
  event.stopImmediatePropagation();
  if (!event.repeat) stop.press("");
}, true);
window.addEventListener("keyup", (event) => {
  // The browser would click the focused button when the key is released.
  if (event.code === "Space" && !keepsSpace(event.target)) { event.preventDefault(); event.stopImmediatePropagation(); }
}, true);
window.addEventListener("keydown", (event) => { if (event.key === "Escape" && typing(event.target)) event.target.blur(); });

const theme = document.getElementById("theme");
theme.setAttribute("aria-label", S.theme);
theme.title = S.theme;
if (localStorage.getItem("theme")) document.documentElement.dataset.theme = localStorage.getItem("theme");
theme.addEventListener("click", () => {
  const dark = document.documentElement.dataset.theme
    ? document.documentElement.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  document.documentElement.dataset.theme = dark ? "light" : "dark";
  localStorage.setItem("theme", document.documentElement.dataset.theme);
});

function route() {
  const found = location.hash.match(/^#\/robot\/(.+)$/);
  let key = "";
  try { key = found ? decodeURIComponent(found[1]) : ""; } catch { key = ""; }
  const other = others[location.hash];
  for (const link of views.children) if (link.hash === (other ? location.hash : "#/")) link.setAttribute("aria-current", "page"); else link.removeAttribute("aria-current");
  if (cameras.node.isConnected && other !== cameras) cameras.close();
  if (other) {
    if (robot.key) robot.close();
    if (other.node.parentNode !== main) {
      main.replaceChildren(other.node);
      view.askThumbnails();
      other.open();
      window.scrollTo(0, 0);
    }
  } else if (key) {
    robot.open(key);
    if (robot.node.parentNode !== main) {
      main.replaceChildren(robot.node);
      view.askThumbnails();
      main.focus({ preventScroll: true });
      window.scrollTo(0, 0);
    }
  } else {
    if (robot.key) robot.close();
    if (view.node.parentNode !== main) { main.replaceChildren(view.node); view.filter.open(); view.anew = true; view.asked = ""; view.askThumbnails(); }
  }
  draw();
}

let asked = false;
function draw() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    if (robot.key) robot.draw(); else if (view.node.isConnected) view.draw();
    resume.draw();
  });
}

state.addEventListener("hello", ({ detail }) => {
  robot.hello = resume.hello = detail;
  setText(document.getElementById("stop-hint"), detail.signed ? S.stopAllSigned : S.stopAll);
  view.starting = detail.starting;
  fleet.begin();
  view.reconnected();
  history.ticket = detail.ticket;
  history.reset();
  history.ask();
  cameras.ask(true);
  robot.resetPictures();
  robot.watch();
  draw();
});
state.addEventListener("fleet", ({ detail }) => { fleet.take(detail); stop.draw(); draw(); });
state.addEventListener("picture", ({ detail }) => { if (cameras.node.isConnected) cameras.picture(detail); else view.picture(detail); });
state.addEventListener("control", ({ detail }) => {
  if (detail.held) fleet.mine.add(detail.key); else fleet.mine.delete(detail.key);
  robot.control_changed(detail);
  draw();
});
state.addEventListener("lost", () => { fleet.mine.clear(); draw(); });
document.addEventListener("visibilitychange", () => { view.askThumbnails(); cameras.ask(); });
window.addEventListener("hashchange", route);
// Ages grow also when nothing arrives.
setInterval(draw, 250);
setInterval(() => state.renewIfSilent(5000), 1000);
route();
