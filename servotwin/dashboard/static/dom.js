// Elements from plain values: text is always text, never HTML.

export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "on") for (const [event, handler] of Object.entries(value)) made.addEventListener(event, handler);
    else if (key === "class") made.className = value;
    else if (value === true) made.setAttribute(key, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(key, value);
  }
  made.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return made;
}

const SVG = "http://www.w3.org/2000/svg";
export function svg(name, attributes = {}, ...children) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

// Sets a text only where it differs, so that nothing is laid out in vain.
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

// Fills a list that is as high as its content, up to its greatest height. While it is on the screen it keeps the
// height that it has, and scrolls inside: nothing below it moves.
export function fill(list, content) {
  const { top, bottom, height } = list.getBoundingClientRect();
  const looked = list.firstChild && bottom > 0 && top < innerHeight;
  list.style.height = looked ? `${height}px` : "";
  list.replaceChildren(content);
}

// The colour that a custom property has in the present theme.
const probe = document.createElement("i");
export function colour(name) {
  if (!probe.isConnected) {
    probe.hidden = true;
    document.body.append(probe);
  }
  probe.style.color = `var(--${name})`;
  return getComputedStyle(probe).color;
}
