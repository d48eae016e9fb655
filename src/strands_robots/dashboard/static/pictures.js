// What a robot sees, and how it stands: two frames whose size does not depend on what is in them.
import { el, setText, showJpeg } from "./dom.js";
import { S } from "./strings.js";

export class Pictures {
  constructor() {
    this.hello = null;
    this.key = this.ledBy = "";
    this.names = [];
    this.camera = el("img", { class: "camera", alt: "" });
    this.pose = el("img", { class: "camera", alt: "" });
    this.chosen = el("select", { id: "camera-name" });
    this.chosen.addEventListener("change", () => this.showCamera());
    this.noCamera = el("p", { class: "small" });
    this.noPose = el("p", { class: "small", role: "status" });
    this.node = el("section", { class: "panel pictures", "aria-labelledby": "camera-title" },
      el("div", { class: "tools" }, el("h3", { id: "camera-title", text: S.camera }), el("label", { for: "camera-name", class: "hidden", text: S.cameraWhich }), this.chosen),
      el("div", { class: "frame" }, this.camera, this.noCamera));
    this.poseNode = el("section", { class: "panel pose", "aria-labelledby": "pose-title" }, el("h3", { id: "pose-title", text: S.pose }),
      el("div", { class: "frame" }, this.pose, this.noPose));
  }

  open(key) { this.key = key; this.reset(); }

  // The streams of pictures end with their connection.
  reset() {
    this.listed = "";
    this.list([], true);
    this.showPose(S.poseComing, true);
  }

  close() {
    this.key = this.ledBy = "";
    // A stream that nobody looks at must end: a browser has six connections to a page.
    for (const image of [this.camera, this.pose]) image.removeAttribute("src");
  }

  details(detail) {
    const listed = JSON.stringify(detail.cameras);
    if (listed !== this.listed && (detail.looked || detail.cameras.length)) { this.listed = listed; this.list(detail.cameras); }
  }

  list(names, coming = false) {
    this.names = names;
    this.chosen.replaceChildren(...names.map((name) => el("option", { value: name, text: name })));
    const own = names.find((name) => name.includes("/") || name.includes(".")) || names.find((name) => name === "front") || names[0];
    if (own) this.chosen.value = own;
    const none = names.length === 0;
    setText(this.noCamera, coming ? S.cameraComing : S.noCamera);
    this.noCamera.hidden = !none;
    this.chosen.disabled = this.camera.hidden = none;
    if (none) this.camera.removeAttribute("src");
    if (!this.ledBy) this.showCamera();
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

  // While the page leads by pictures of a camera they come numbered, and each is told once it is seen.
  led(camera) {
    this.ledBy = camera;
    this.chosen.value = camera;
    this.chosen.disabled = true;
    this.camera.removeAttribute("src");
  }

  ledNoMore() {
    if (!this.ledBy) return;
    this.ledBy = "";
    this.chosen.disabled = this.names.length === 0;
    this.showCamera();
  }

  ledPicture(jpeg, seen) {
    if (!this.ledBy) return;
    showJpeg(this.camera, jpeg);
    this.camera.decode().then(seen, () => {});
  }

  showCamera() { if (this.chosen.value) this.show(this.camera, this.chosen.value); }

  show(image, camera, drawn = false) {
    if (!this.hello || !this.key) return;
    const id = this.key.slice(this.key.indexOf(":") + 1);
    image.alt = drawn ? S.poseOf(id) : S.pictureOf(id, camera);
    image.src = `camera?${new URLSearchParams({ robot: this.key, camera, ticket: this.hello.ticket, ...(drawn ? { pose: "1" } : {}) })}`;
  }
}
