"use strict";
// The page of a graph: a 3D view (three.js), filters, a list of objects, the card of one object.
// Positions are in metres, with z up.

const graph = JSON.parse(document.getElementById("graph").textContent);
const nodes = new Map(graph.nodes.map(node => [node.id, node]));
const name = id => `${nodes.get(id).label}${nodes.get(id).sure ? "" : "?"} ${id}`;
const percent = value => `${Math.round(100 * value)}\u00a0%`;
const byId = id => document.getElementById(id);

function element(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

// --- what is shown -------------------------------------------------------------------------------

// So many edges are "near" that they hide the others.
const hiddenPredicates = new Set("near" in graph.tints ? ["near"] : []);
const hiddenClasses = new Set();
const hiddenKinds = new Set();
const least = { object: 0, relation: 0.5 };
let chosen = null;  // id of the object that was clicked
let pointed = null;  // id of the object under the pointer

const isOf = (edge, id) => edge.subject === id || edge.object === id;
const showsNode = node => !hiddenClasses.has(node.label) && node.probability >= least.object;
const showsEdge = edge => !hiddenPredicates.has(edge.predicate) &&
  edge.probability >= least.relation &&
  showsNode(nodes.get(edge.subject)) && showsNode(nodes.get(edge.object));

// --- the 3D view ---------------------------------------------------------------------------------

const view = byId("view");
const renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
const scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(50, 1, 0.05, 1000);
camera.up.set(0, 0, 1);
const controls = new THREE.OrbitControls(camera, renderer.domElement);
view.prepend(renderer.domElement);
scene.add(new THREE.AmbientLight(0xffffff, 2.2));
const sun = new THREE.DirectionalLight(0xffffff, 1.5);
sun.position.set(1, -2, 3);
scene.add(sun);

const unitBox = new THREE.BoxGeometry(1, 1, 1);
const unitEdges = new THREE.EdgesGeometry(unitBox);

function boxOf(node) {
  const group = new THREE.Group();
  const body = new THREE.Mesh(unitBox, new THREE.MeshLambertMaterial({
    color: node.colour, transparent: true, opacity: 0.16, depthWrite: false }));
  const rim = new THREE.LineSegments(unitEdges, new THREE.LineBasicMaterial({
    color: node.colour, transparent: true, opacity: node.sure ? 0.95 : 0.45 }));
  body.userData.id = node.id;
  group.add(body, rim);
  const [a, b, c, d, e, f, g, h, i] = node.axes;
  group.matrixAutoUpdate = false;
  const [x, y, z] = node.size.map(side => Math.max(side, 0.005));
  group.matrix.set(a * x, d * y, g * z, node.centre[0], b * x, e * y, h * z, node.centre[1],
    c * x, f * y, i * z, node.centre[2], 0, 0, 0, 1);
  group.matrixWorldNeedsUpdate = true;
  return { node, group, body, rim };
}

function cloudsOf({ low, step, counts, xyz }) {
  const bytes = Uint8Array.from(atob(xyz), character => character.charCodeAt(0));
  const steps = new Uint16Array(bytes.buffer);
  let start = 0;
  return graph.nodes.map((node, row) => {
    const values = new Float32Array(3 * counts[row]);
    for (let at = 0; at < values.length; at++) values[at] = low[at % 3] + step * steps[start + at];
    start += values.length;
    const shape = new THREE.BufferGeometry();
    shape.setAttribute("position", new THREE.Float32BufferAttribute(values, 3));
    return new THREE.Points(shape, new THREE.PointsMaterial({
      color: node.colour, size: 2, sizeAttenuation: false, transparent: true, opacity: 0.7 }));
  });
}

// An edge and its opposite bend to different sides.
function curveOf(edge) {
  const tail = new THREE.Vector3(...nodes.get(edge.subject).centre);
  const tip = new THREE.Vector3(...nodes.get(edge.object).centre);
  const chord = tip.clone().sub(tail), length = chord.length();
  const side = chord.clone().cross(camera.up);
  if (side.length() < 0.05 * length) side.set(0.3 * length, 0, 0);
  const middle = tail.clone().add(tip).multiplyScalar(0.5)
    .addScaledVector(side, 0.16).addScaledVector(camera.up, 0.06 * length);
  return new THREE.QuadraticBezierCurve3(tail, middle, tip);
}

const cone = new THREE.ConeGeometry(1, 2.6, 10);
cone.rotateX(Math.PI / 2);  // it points along z

function arrowOf(edge) {
  const curve = curveOf(edge), length = Math.max(curve.getLength(), 1e-3);
  const paint = new THREE.MeshBasicMaterial({ color: graph.tints[edge.predicate],
    transparent: true, opacity: 0.25 + 0.65 * edge.probability ** 2 });
  const group = new THREE.Group();
  const radius = Math.min(0.0022 * reach, 0.03 * length);
  group.add(new THREE.Mesh(new THREE.TubeGeometry(curve, 16, radius, 5), paint));
  const head = new THREE.Mesh(cone, paint);
  head.scale.setScalar(3.2 * radius);
  head.position.copy(curve.getPoint(0.86));
  head.lookAt(head.position.clone().add(curve.getTangent(0.86)));
  group.add(head);
  return { edge, group, paint, middle: curve.getPoint(0.5) };
}

// Everything that is drawn is between these corners.
const low = new THREE.Vector3(Infinity, Infinity, Infinity);
const high = low.clone().negate();
for (const { centre, size } of graph.nodes) {
  const half = Math.hypot(...size) / 2;
  low.min(new THREE.Vector3(...centre).addScalar(-half));
  high.max(new THREE.Vector3(...centre).addScalar(half));
}
for (const place of graph.path) {
  low.min(new THREE.Vector3(...place));
  high.max(new THREE.Vector3(...place));
}
if (low.x > high.x) { low.set(-1, -1, 0); high.set(1, 1, 1); }
const room = high.clone().sub(low);
const reach = Math.max(room.x, room.y, room.z, 0.5);

const boxes = graph.nodes.map(boxOf);
const clouds = cloudsOf(graph.points);
const arrows = graph.edges.map(arrowOf);
for (const part of [...boxes, ...arrows]) scene.add(part.group);
for (const cloud of clouds) scene.add(cloud);

// Lines on the floor, a metre apart.
const cells = Math.min(2 * Math.ceil(reach / 2) + 2, 200);
const floor = new THREE.GridHelper(cells, cells);
floor.rotateX(Math.PI / 2);
floor.position.set(Math.round((low.x + high.x) / 2), Math.round((low.y + high.y) / 2), low.z);
scene.add(floor);

if (graph.path.length > 1) {
  const shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.Float32BufferAttribute(graph.path.flat(), 3));
  scene.add(new THREE.Line(shape, new THREE.LineBasicMaterial({ color: 0x8d93a5 })));
}

function home() {
  controls.target.copy(low).add(high).multiplyScalar(0.5);
  camera.position.copy(controls.target).add(
    new THREE.Vector3(-0.1, -0.85, 0.75).multiplyScalar(reach));
}

// --- labels: those that would cover another one are left out ----------------------------------

const labels = byId("labels");
const taken = [];

function put(text, place, className, colour) {
  const at = place.clone().project(camera);
  if (at.z > 1 || Math.abs(at.x) > 1.1 || Math.abs(at.y) > 1.1) return;
  const x = (at.x + 1) / 2 * view.clientWidth, y = (1 - at.y) / 2 * view.clientHeight;
  // About 6.6 pixels a character: measuring each text would take longer than drawing it.
  const width = 6.6 * text.length + 4, height = 15;
  const box = [x - width / 2, y - height / 2, x + width / 2, y + height / 2];
  if (taken.some(o => box[0] < o[2] && box[2] > o[0] && box[1] < o[3] && box[3] > o[1])) return;
  taken.push(box);
  const label = element("span", className, text);
  label.style.transform = `translate(${x}px, ${y}px) translate(-50%, -50%)`;
  if (colour) label.style.color = colour;
  labels.append(label);
}

const top_ = node => new THREE.Vector3(...node.centre).setZ(node.centre[2] + node.size[2] / 2);
const bySight = [...graph.nodes].sort((a, b) => b.observations - a.observations);

function drawLabels() {
  labels.replaceChildren();
  taken.length = 0;
  if (hiddenKinds.has("labels")) return;
  const first = pointed ?? chosen;
  if (first !== null) {
    put(name(first), top_(nodes.get(first)), "strong");
    for (const { edge, middle } of arrows)
      if (isOf(edge, first) && showsEdge(edge)) put(edge.predicate, middle, "predicate strong");
  }
  for (const node of bySight)
    if (node.id !== first && showsNode(node)) put(name(node.id), top_(node), "");
  if (first === null && !hiddenKinds.has("relations"))
    for (const { edge, middle } of arrows)
      if (showsEdge(edge)) put(edge.predicate, middle, "predicate", graph.tints[edge.predicate]);
}

// --- drawing -------------------------------------------------------------------------------------

let isDue = false;
function draw() {
  if (isDue) return;
  isDue = true;
  requestAnimationFrame(() => {
    isDue = false;
    renderer.render(scene, camera);
    drawLabels();
  });
}

function refresh() {
  const first = pointed ?? chosen;
  const isNear = id => first === null || id === first ||
    graph.edges.some(edge => isOf(edge, first) && isOf(edge, id) && showsEdge(edge));
  boxes.forEach(({ node, group, body, rim }, row) => {
    group.visible = !hiddenKinds.has("boxes") && showsNode(node);
    clouds[row].visible = !hiddenKinds.has("points") && showsNode(node);
    body.material.opacity = node.id === first ? 0.4 : isNear(node.id) ? 0.16 : 0.05;
    rim.material.opacity = isNear(node.id) ? (node.sure ? 0.95 : 0.45) : 0.2;
  });
  for (const { edge, group, paint } of arrows) {
    group.visible = !hiddenKinds.has("relations") && showsEdge(edge) &&
      (first === null || isOf(edge, first));
    paint.opacity = first === null ? 0.25 + 0.65 * edge.probability ** 2 : 1;
  }
  for (const item of document.querySelectorAll("#list li.object")) {
    const id = Number(item.dataset.id);
    item.classList.toggle("chosen", id === chosen);
    item.classList.toggle("off", !showsNode(nodes.get(id)));
  }
  showCard(first);
  draw();
}

function recolour() {
  const style = getComputedStyle(document.documentElement);
  floor.material.vertexColors = false;
  floor.material.color.set(style.getPropertyValue("--grid").trim());
  floor.material.needsUpdate = true;
  draw();
}

function choose(id) {
  chosen = id;
  pointed = null;
  if (id !== null) {
    const node = nodes.get(id), target = new THREE.Vector3(...node.centre);
    const away = camera.position.clone().sub(controls.target);
    away.setLength(Math.min(away.length(), Math.max(1.2, 4 * Math.max(...node.size))));
    controls.target.copy(target);
    camera.position.copy(target).add(away);
    controls.update();
  }
  refresh();
}

// --- the card of an object -----------------------------------------------------------------------

function showCard(id) {
  const card = byId("card");
  if (id === null) {
    card.replaceChildren(element("span", "hint", graph.nodes.length
      ? "Point at a box to see its relations. Click it to keep them, Esc to let go." : ""));
    return;
  }
  const node = nodes.get(id), facts = element("dl");
  const classes = node.classes.filter(([, p]) => p >= 0.01).slice(0, 4)
    .map(([label, p]) => `${label} ${percent(p)}`);
  if (node.other >= 0.01) classes.push(`others ${percent(node.other)}`);
  for (const [term, text] of [
    [node.named ? `is a ${node.label}` : "is an object", percent(node.probability)],
    ["exists", node.existence === null ? null : percent(node.existence)],
    ["if it exists", (node.named ? "" : "perhaps ") + classes.join(", ")],
    ["size", `${node.sizeWords.join(" × ")} cm`],
    ["colour", node.looks],
    ["position", `${node.position.map(value => value.toFixed(2)).join(", ")} m`],
    ["seen in", `${node.observations} frame${node.observations === 1 ? "" : "s"}`],
  ]) if (text !== null) facts.append(element("dt", "", term), element("dd", "", text));
  const list = element("ul");
  for (const edge of graph.edges.filter(edge => isOf(edge, id) && showsEdge(edge))) {
    const line = element("li");
    line.append(name(edge.subject), " ", element("b", "", edge.verb), " ", name(edge.object),
      " ", element("span", "quiet", `${percent(edge.probability)}, ${SOURCES[edge.provenance]}`));
    line.onclick = () => choose(edge.subject === id ? edge.object : edge.subject);
    list.append(line);
  }
  card.replaceChildren(element("h2", "", name(id)), facts, list);
}

const SOURCES = { visual: "seen", prior: "judged by the world model",
  fused: "seen, and judged by the world model", operator: "said by an operator" };

// --- filters and list ----------------------------------------------------------------------------

for (const kind of ["object", "relation"]) {
  const slider = byId(`least-${kind}`), shown = slider.nextElementSibling;
  const apply = () => {
    least[kind] = slider.value / 100;
    shown.textContent = `${slider.value}\u00a0%`;
  };
  slider.oninput = () => { apply(); refresh(); };
  apply();
}

function toggle(set, key, colour) {
  const box = element("input");
  box.type = "checkbox";
  box.checked = !set.has(key);
  if (colour) box.style.accentColor = colour;
  box.onchange = () => { box.checked ? set.delete(key) : set.add(key); refresh(); };
  return box;
}

for (const [predicate, tint] of Object.entries(graph.tints)) {
  const count = graph.edges.filter(edge => edge.predicate === predicate).length;
  const label = element("label");
  label.append(toggle(hiddenPredicates, predicate, tint), predicate, " ",
    element("span", "quiet", count));
  byId("predicates").append(label);
}

for (const box of document.querySelectorAll("#switches input"))
  box.onchange = () => {
    box.checked ? hiddenKinds.delete(box.dataset.kind) : hiddenKinds.add(box.dataset.kind);
    refresh();
  };

function objectItem(node) {
  const item = element("li", "object"), dot = element("span", "dot");
  item.dataset.id = node.id;
  dot.style.background = node.colour;
  item.append(dot, element("span", "name", name(node.id)),
    element("span", "quiet", percent(node.probability)));
  item.onclick = () => choose(node.id);
  item.onmouseenter = () => { pointed = node.id; refresh(); };
  item.onmouseleave = () => { pointed = null; refresh(); };
  return item;
}

function fillList(filter) {
  const groups = new Map();
  for (const node of graph.nodes)
    if (name(node.id).toLowerCase().includes(filter))
      groups.set(node.label, [...(groups.get(node.label) || []), node]);
  byId("list").replaceChildren(...[...groups.keys()].sort().flatMap(label => {
    const members = groups.get(label), header = element("li", "class"), text = element("label", "name");
    text.append(toggle(hiddenClasses, label, members[0].colour), label);
    header.append(text, element("span", "quiet", members.length));
    return [header, ...members.map(objectItem)];
  }));
}

byId("search").oninput = event => { fillList(event.target.value.trim().toLowerCase()); refresh(); };

// --- an empty graph says why ---------------------------------------------------------------------

if (!graph.nodes.length) {
  const why = element("div"), reasons = Object.entries(graph.hidden);
  why.id = "empty";
  why.append(element("h2", "", "No objects in this graph."));
  if (reasons.length) {
    const list = element("ul");
    for (const [reason, count] of reasons) list.append(element("li", "", `${count}: ${reason}`));
    why.append(element("p", "", "These were detected, and are not in the graph:"), list);
  } else why.append(element("p", "", "Nothing was detected. The detector may not know what is in " +
    "view, or depth or poses may be missing. The command `deworldsg doctor RECORDING` looks for " +
    "the cause."));
  view.append(why);
}

// --- pointer, keys, size -------------------------------------------------------------------------

const caster = new THREE.Raycaster();
let pressed = null;

function under(event) {
  const frame = renderer.domElement.getBoundingClientRect();
  caster.setFromCamera(new THREE.Vector2(
    2 * (event.clientX - frame.left) / frame.width - 1,
    1 - 2 * (event.clientY - frame.top) / frame.height), camera);
  const shown = boxes.filter(box => box.group.visible).map(box => box.body);
  const hits = caster.intersectObjects(shown, false).map(hit => hit.object.userData.id);
  // A cup inside the box of a table: the smallest box under the pointer is meant.
  const volume = id => nodes.get(id).size.reduce((a, b) => a * b, 1);
  return hits.length ? hits.reduce((a, b) => volume(b) < volume(a) ? b : a) : null;
}

renderer.domElement.addEventListener("pointermove", event => {
  if (event.buttons || event.pointerType === "touch") return;
  const id = under(event);
  if (id !== pointed) { pointed = id; refresh(); }
});
renderer.domElement.addEventListener("pointerdown", event => {
  pressed = [event.clientX, event.clientY];
});
renderer.domElement.addEventListener("pointerup", event => {
  const moved = Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]);
  if (moved < 5) choose(under(event));
});
document.addEventListener("keydown", event => {
  if (event.key !== "Escape") return;
  if (chosen === null && pointed === null) { home(); controls.update(); }
  choose(null);
});
controls.addEventListener("change", draw);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);

new ResizeObserver(() => {
  renderer.setPixelRatio(window.devicePixelRatio);
  renderer.setSize(view.clientWidth, view.clientHeight, false);
  renderer.domElement.style.width = renderer.domElement.style.height = "100%";
  camera.aspect = view.clientWidth / Math.max(view.clientHeight, 1);
  camera.updateProjectionMatrix();
  draw();
}).observe(view);

const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
byId("title").textContent =
  `${plural(graph.nodes.length, "object")}, ${plural(graph.edges.length, "relation")}`;
byId("subtitle").textContent = `world frame “${graph.frame_id}”`;
fillList("");
home();
controls.update();
recolour();
refresh();
