// Redrawing without a jolt: elements that are there stay there, and only what differs is changed. So
// focus stays where it is, a click that spans a redraw arrives, and a screen reader reads nothing twice.

// Makes `target` show `children`. An element is taken for the same as before when tag, `data-key` and,
// for a button, its text agree; what its handlers do must depend on nothing else.
export function renew(target, ...children) {
  const wanted = children.flat(Infinity).filter((child) => child !== null && child !== undefined);
  sync(target, wanted.map((child) => (child instanceof Node ? child : document.createTextNode(child))));
}

function sync(target, wanted) {
  const old = new Map(); // name → elements of that name, in order
  for (const node of target.childNodes) {
    if (!old.has(nameOf(node))) old.set(nameOf(node), []);
    old.get(nameOf(node)).push(node);
  }
  const shown = wanted.map((node) => {
    const same = old.get(nameOf(node))?.shift();
    return same ? merge(same, node) : node;
  });
  for (const node of [...old.values()].flat()) node.remove();
  // Moving an element takes its focus away: put the others around it.
  let next = target.firstChild;
  for (const node of shown) {
    if (node === next) next = next.nextSibling;
    else target.insertBefore(node, next);
  }
}

function nameOf(node) {
  if (!(node instanceof Element)) return node.nodeName;
  return `${node.tagName} ${node.dataset.key ?? ""} ${node.tagName === "BUTTON" ? node.textContent : ""}`;
}

function merge(old, made) {
  if (!(old instanceof Element)) {
    if (old.data !== made.data) old.data = made.data;
    return old;
  }
  for (const name of old.getAttributeNames()) if (!made.hasAttribute(name)) old.removeAttribute(name);
  for (const name of made.getAttributeNames()) {
    const value = made.getAttribute(name);
    if (old.getAttribute(name) !== value) old.setAttribute(name, value);
  }
  sync(old, [...made.childNodes]);
  return old;
}
