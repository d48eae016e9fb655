// Elements are made from text and never from markup, so that a robot's name cannot be code.
export function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "text") node.textContent = value;
    else node.setAttribute(name, value === true ? "" : String(value));
  }
  for (const child of children) if (child !== null && child !== undefined) node.append(child);
  return node;
}

// An entry of a table, never what every object inherits: a robot may call a joint `constructor`.
export const own = (table, name) => (table && Object.hasOwn(table, name) ? table[name] : undefined);

export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

export function setAttr(node, name, value) {
  const text = String(value);
  if (node.getAttribute(name) !== text) node.setAttribute(name, text);
}

// A line of a fixed height shows what fits; the rest is its title.
export function setLine(node, text) {
  setText(node, text);
  setAttr(node, "title", text);
}

// A place that is kept: what is in it comes and goes, and what is below it stays.
export function setShown(node, shown) {
  setAttr(node, "data-shown", shown ? "yes" : "no");
}

export function showJpeg(image, bytes) {
  const old = image.src;
  image.src = URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" }));
  if (old.startsWith("blob:")) URL.revokeObjectURL(old);
}

export function typing(target) {
  return target instanceof HTMLTextAreaElement ||
    (target instanceof HTMLInputElement && !["button", "submit", "range"].includes(target.type));
}

// Space is the key of these: it types, opens a list, or scrolls on from a link.
export function keepsSpace(target) {
  return typing(target) || target instanceof HTMLSelectElement || (target instanceof HTMLAnchorElement && target.hasAttribute("href"));
}
