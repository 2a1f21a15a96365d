"use strict";
// The page of a graph: a 3D view (three.js), filters, a list of objects, the card of one object.
// Positions are in metres, with z up. A kept page has its only message inside; a live one gets
// messages with what changed from its server, and tells it what it wants to see.

const byId = id => document.getElementById(id);
const kept = JSON.parse(byId("graph").textContent);
const isLive = kept === null;

const nodes = new Map(), edges = new Map(), clouds = new Map(), photos = new Map();
let head = { colours: {}, tints: {}, verbs: {}, frame_id: "", hidden: {}, rooms: [],
  why: "waiting for the server" };
let path = [];  // where the camera was
let eye = null;  // the camera now: centre, axes, fov, aspect

const keyOf = ({ subject, object }) => `${subject} ${object}`;
const name = id => `${nodes.get(id).label}${nodes.get(id).sure ? "" : "?"} ${id}`;
const percent = value => `${Math.round(100 * value)}\u00a0%`;
const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;

function element(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

// --- what is shown -------------------------------------------------------------------------------

// So many edges are "near" that they hide the others.
const hiddenPredicates = new Set(["near"]);
const hiddenClasses = new Set();
const cutOut = new Set();  // ids of single objects that are hidden
const hiddenKinds = new Set(["Gaussians", "follow"]);
const least = { object: 0, relation: 0.5 };
let chosen = null;  // id of the object that was clicked
let pointed = null;  // id of the object under the pointer

const isOf = (edge, id) => edge.subject === id || edge.object === id;
const isCut = node => hiddenClasses.has(node.label) || cutOut.has(node.id);
const showsNode = node => !isCut(node) && node.probability >= least.object;

// Of two equal relations in both directions, the less probable one says nothing more.
function isDouble(edge) {
  const other = edge.mutual && edges.get(`${edge.object} ${edge.subject}`);
  return other && other.predicate === edge.predicate &&
    (other.probability - edge.probability || edge.subject - edge.object) > 0;
}

// That it holds, and that both are what they are called.
const tripletOf = edge =>
  edge.probability * nodes.get(edge.subject).probability * nodes.get(edge.object).probability;

const showsEdge = edge => !hiddenPredicates.has(edge.predicate) && !isDouble(edge) &&
  nodes.has(edge.subject) && nodes.has(edge.object) && tripletOf(edge) >= least.relation &&
  showsNode(nodes.get(edge.subject)) && showsNode(nodes.get(edge.object));
const visibleNodes = () => [...nodes.values()].filter(showsNode);
const visibleEdges = () => {
  const first = pointed ?? chosen;
  return hiddenKinds.has("relations") ? [] : [...edges.values()].filter(
    edge => showsEdge(edge) && (first === null || isOf(edge, first)));
};

// --- the 3D view: a few meshes, whatever the number of objects ------------------------------------

const view = byId("view");
const renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
// This check waits for each shader, so that they are compiled one after another. Tests look at the
// pixels instead.
renderer.debug.checkShaderErrors = false;
const scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(50, 1, 0.05, 1000);
camera.up.set(0, 0, 1);
const controls = new THREE.OrbitControls(camera, renderer.domElement);
view.prepend(renderer.domElement);

const paint = { vertexColors: true, transparent: true, depthWrite: false };
const empty = () => new THREE.BufferGeometry();
const layers = {
  faces: new THREE.Mesh(empty(), new THREE.MeshBasicMaterial(paint)),
  rims: new THREE.LineSegments(empty(), new THREE.LineBasicMaterial(paint)),
  rings: new THREE.LineSegments(empty(), new THREE.LineBasicMaterial(paint)),
  points: new THREE.Points(empty(), new THREE.PointsMaterial(
    { ...paint, size: 2, sizeAttenuation: false })),
  arrows: new THREE.Mesh(empty(), new THREE.MeshBasicMaterial(paint)),
  camera: new THREE.LineSegments(empty(), new THREE.LineBasicMaterial(paint)),
  // Seen through the points of the floor.
  rooms: new THREE.LineSegments(empty(), new THREE.LineBasicMaterial({ ...paint, depthTest: false })),
};
for (const layer of Object.values(layers)) {
  layer.frustumCulled = false;
  scene.add(layer);
}

// The room: points of the surfaces that the camera saw, in their colours.
const room = { places: new Float32Array(0), colours: new Float32Array(0), sides: new Int8Array(0),
  gone: new Set(), cell: 0.02 };
let hasChosenPoints = false;  // else those of the room take the place of those of the objects
layers.room = new THREE.Points(empty(), new THREE.PointsMaterial(
  { vertexColors: true, transparent: true, size: 0.03 }));
// A wall is seen from its own side: from outside one looks into the room. The points of the first
// object stay as they are when the others step back.
const inFirst = { value: new THREE.Matrix4() }, hasFirst = { value: 0 };
layers.room.material.onBeforeCompile = shader => {
  Object.assign(shader.uniforms, { inFirst, hasFirst });
  shader.vertexShader = shader.vertexShader
    .replace("void main() {", `attribute vec3 side;
      uniform mat4 inFirst; uniform float hasFirst; varying float isFirst;
      void main() {
        vec3 inside = abs((inFirst * vec4(position, 1.0)).xyz);
        isFirst = hasFirst * step(max(inside.x, max(inside.y, inside.z)), 1.0);`)
    .replace("#include <project_vertex>", `#include <project_vertex>
      if (dot(normalize(cameraPosition - position), side) < -0.1)
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0);`);
  shader.fragmentShader = shader.fragmentShader
    .replace("void main() {", "varying float isFirst;\nvoid main() {")
    .replace("#include <color_fragment>", `#include <color_fragment>
      diffuseColor.a = mix(diffuseColor.a, 1.0, isFirst);`);
};
layers.room.frustumCulled = false;
layers.room.renderOrder = -1;
scene.add(layers.room);

function bytesOf(text) {
  const characters = atob(text), bytes = new Uint8Array(characters.length);
  for (let at = 0; at < bytes.length; at++) bytes[at] = characters.charCodeAt(at);
  return bytes;
}

// Linear light of the 256 steps of sRGB.
const LINEAR = Float32Array.from({ length: 256 }, (_, step) =>
  new THREE.Color().setRGB(step / 255, 0, 0, "srgb").r);

function addToRoom({ from = 0, gone = [], origin, step, cell, steps, rgb, sides: seen }) {
  const start = 3 * from, more = steps ? new Int16Array(bytesOf(steps).buffer) : [];
  const sides = new Int8Array(start + more.length);
  const places = new Float32Array(start + more.length), colours = new Float32Array(places.length);
  places.set(room.places.subarray(0, start));
  colours.set(room.colours.subarray(0, start));
  sides.set(room.sides.subarray(0, start));
  if (steps) sides.set(new Int8Array(bytesOf(seen).buffer), start);
  const bytes = steps ? bytesOf(rgb) : [];
  for (let at = 0; at < more.length; at++) places[start + at] = origin[at % 3] + step * more[at];
  for (let at = 0; at < bytes.length; at++) colours[start + at] = LINEAR[bytes[at]];
  if (from === 0) room.gone.clear();
  for (const row of gone) room.gone.add(row);
  Object.assign(room, { places, colours, sides, cell: cell ?? room.cell });
}

// A point belongs to an object up to so far outside of its box, metres.
const MARGIN = 0.02;

// From the world to a box whose sides are at -1 and 1.
function toBox({ centre, axes, size }) {
  const rows = [0, 1, 2].flatMap(k => {
    const axis = axes.slice(3 * k, 3 * k + 3), half = size[k] / 2 + MARGIN;
    return [...axis.map(value => value / half),
      -axis.reduce((sum, value, at) => sum + value * centre[at], 0) / half];
  });
  return new THREE.Matrix4().set(...rows, 0, 0, 0, 1);
}

// Rows of the room's points that are not drawn: what went, and what is in a hidden object.
function leftOut() {
  const out = new Set(room.gone), places = room.places;
  for (const node of nodes.values()) {
    if (!isCut(node)) continue;
    const m = toBox(node).elements;
    for (let at = 0; at < places.length; at += 3) {
      const x = places[at], y = places[at + 1], z = places[at + 2];
      if (Math.abs(m[0] * x + m[4] * y + m[8] * z + m[12]) <= 1 &&
          Math.abs(m[1] * x + m[5] * y + m[9] * z + m[13]) <= 1 &&
          Math.abs(m[2] * x + m[6] * y + m[10] * z + m[14]) <= 1) out.add(at / 3);
    }
  }
  return out;
}

// Which objects are hidden, and about where.
const cuts = () => [...nodes.values()].filter(isCut)
  .map(({ id, centre, size }) => [id, ...[...centre, ...size].map(value => value.toFixed(2))]).join();
let drawnCuts = "";

function drawRoom() {
  drawnCuts = cuts();
  const out = leftOut(), isKept = (_, at) => !out.has(Math.floor(at / 3));
  const kept = values => out.size ? values.filter(isKept) : values;
  const sides = Float32Array.from(kept(room.sides), value => value / 127);
  const shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.Float32BufferAttribute(kept(room.places), 3));
  shape.setAttribute("color", new THREE.Float32BufferAttribute(kept(room.colours), 3));
  shape.setAttribute("side", new THREE.Float32BufferAttribute(sides, 3));
  // three.js takes the size as that of a view of 90 degrees.
  layers.room.material.size = 1.2 * room.cell / Math.tan(camera.fov * Math.PI / 360);
  layers.room.geometry.dispose();
  layers.room.geometry = shape;
  if (!hasChosenPoints && room.places.length) {
    hiddenKinds.add("points");
    document.querySelector("#switches [data-kind=points]").checked = false;
    drawPoints();
  }
  dimRoom();
}

// The room steps back behind a chosen object. Its floor takes the place of the grid.
function dimRoom() {
  layers.room.visible = room.places.length > 0 && !hiddenKinds.has("room");
  const first = pointed ?? chosen;
  layers.room.material.opacity = first === null ? 1 : 0.35;
  hasFirst.value = first === null ? 0 : 1;
  if (first !== null) inFirst.value.copy(toBox(nodes.get(first)));
  if (floor) floor.visible = room.places.length < 3000 || hiddenKinds.has("room");
}

function fill(layer, positions, colours, index) {
  const shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  shape.setAttribute("color", new THREE.Float32BufferAttribute(colours, 4));
  if (index) shape.setIndex(index);
  layer.geometry.dispose();
  layer.geometry = shape;
  layer.visible = positions.length > 0;
}

const known = new Map();
function rgb(colour) {
  if (!known.has(colour)) known.set(colour, new THREE.Color(colour).toArray());
  return known.get(colour);
}
const rgbOf = node => rgb(head.colours[node.label] ?? "#8d93a5");

// Corners of a unit cube, its sides and its triangles.
const CORNERS = [...Array(8).keys()].map(k => [k >> 2 & 1, k >> 1 & 1, k & 1].map(b => b - 0.5));
const SIDES = [0, 1, 0, 2, 0, 4, 1, 3, 1, 5, 2, 3, 2, 6, 3, 7, 4, 5, 4, 6, 5, 7, 6, 7];
const TRIANGLES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4],
  [1, 5, 7, 3]].flatMap(([a, b, c, d]) => [a, b, c, a, c, d]);

function cornersOf({ centre, axes, size }) {
  const [x, y, z] = size.map(side => Math.max(side, 0.005));
  return CORNERS.map(([i, j, k]) => [0, 1, 2].map(at =>
    centre[at] + i * x * axes[at] + j * y * axes[3 + at] + k * z * axes[6 + at]));
}

function drawBoxes() {
  const first = pointed ?? chosen, near = new Set([first]);
  if (first !== null)
    for (const edge of edges.values())
      if (isOf(edge, first) && showsEdge(edge)) near.add(edge.subject).add(edge.object);
  const places = [], faceColours = [], rimColours = [], index = [], rims = [], sides = [];
  const rings = [], ringColours = [];
  for (const node of visibleNodes()) {
    const colour = rgbOf(node), isNear = first === null || near.has(node.id);
    const start = places.length / 3;
    const opacity = node.id === first ? 0.4 : isNear ? (node.sure ? 0.18 : 0.08) : 0.04;
    const rim = isNear ? (node.sure ? 0.95 : 0.45) : 0.2;
    if (!hiddenKinds.has("boxes")) {
      for (const corner of cornersOf(node)) {
        places.push(...corner);
        faceColours.push(...colour, opacity);
        rimColours.push(...colour, rim);
      }
      for (const corner of TRIANGLES) index.push(start + corner);
      for (const corner of SIDES) sides.push(start + corner);
    }
    if (!hiddenKinds.has("Gaussians"))
      for (const [a, b] of [[0, 3], [3, 6], [6, 0]])
        for (let step = 0; step < 48; step++) {
          const angle = Math.PI * Math.floor((step + 1) / 2) / 12, d = node.deviations;
          for (let at = 0; at < 3; at++)
            rings.push(node.mean[at] + Math.cos(angle) * d[a + at] + Math.sin(angle) * d[b + at]);
          ringColours.push(...colour, rim);
        }
  }
  fill(layers.faces, places, faceColours, index);
  fill(layers.rims, places, rimColours, sides);
  fill(layers.rings, rings, ringColours);
}

function drawPoints() {
  const shown = hiddenKinds.has("points") ? [] : visibleNodes().filter(({ id }) => clouds.has(id));
  const count = shown.reduce((sum, { id }) => sum + clouds.get(id).length, 0);
  const places = new Float32Array(count), colours = new Float32Array(count / 3 * 4);
  const first = pointed ?? chosen;
  let at = 0;
  for (const node of shown) {
    const cloud = clouds.get(node.id), colour = rgbOf(node);
    places.set(cloud, at);
    for (let row = at / 3; row < (at + cloud.length) / 3; row++) {
      colours.set(colour, 4 * row);
      colours[4 * row + 3] = first === null || node.id === first ? 0.7 : 0.15;
    }
    at += cloud.length;
  }
  fill(layers.points, places, colours);
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

let middles = [];  // of the drawn relations: [edge, place]

// Tubes of three sides, with a cone where a relation has a direction.
function drawArrows() {
  const places = [], colours = [], index = [];
  const first = pointed ?? chosen, parts = 10, place = new THREE.Vector3();
  middles = [];
  for (const edge of visibleEdges()) {
    const curve = curveOf(edge), length = Math.max(curve.getLength(), 1e-3);
    const radius = Math.min(0.0022 * reach, 0.03 * length);
    const colour = [...rgb(head.tints[edge.predicate] ?? "#8d93a5"),
      first === null ? 0.25 + 0.65 * tripletOf(edge) ** 2 : 1];
    const rings = [...Array(parts + 1).keys()].map(step => [step / parts, radius]);
    if (!edge.mutual) {
      const tip = 0.9, base = tip - Math.min(10 * radius / length, 0.3);
      rings.splice(0, Infinity, ...rings.filter(([at]) => at < base), [base, radius],
        [base, 3.2 * radius], [tip, 0]);
    }
    const start = places.length / 3;
    for (const [at, wide] of rings) {
      const along = curve.getTangent(at), side = along.clone().cross(camera.up);
      if (side.length() < 1e-3) side.set(1, 0, 0);
      side.normalize();
      const up = side.clone().cross(along);
      for (let corner = 0; corner < 3; corner++) {
        const angle = 2 * Math.PI * corner / 3;
        curve.getPoint(at, place).addScaledVector(side, wide * Math.cos(angle))
          .addScaledVector(up, wide * Math.sin(angle));
        places.push(place.x, place.y, place.z);
        colours.push(...colour);
      }
    }
    for (let ring = start; ring < places.length / 3 - 3; ring += 3)
      for (let corner = 0; corner < 3; corner++) {
        const a = ring + corner, b = ring + (corner + 1) % 3;
        index.push(a, b, a + 3, b, b + 3, a + 3);
      }
    middles.push([edge, curve.getPoint(0.5)]);
  }
  fill(layers.arrows, places, colours, index);
}

// The way of the camera, and the pyramid of what it sees.
function drawCamera() {
  const places = [], colours = [];
  if (!hiddenKinds.has("camera")) {
    for (let at = 1; at < path.length; at++) places.push(...path[at - 1], ...path[at]);
    if (eye !== null) {
      const { centre, axes: [right, down, forward] } = eye;
      const depth = 0.08 * reach, high = Math.tan(eye.fov / 2), wide = high * eye.aspect;
      const corner = (x, y) => centre.map((value, at) =>
        value + depth * (forward[at] + x * wide * right[at] + y * high * down[at]));
      const corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
      corners.forEach((place, at) =>
        places.push(...centre, ...place, ...place, ...corners[(at + 1) % 4]));
    }
    const colour = rgb("#d9822b");
    for (let at = 0; at < places.length; at += 3) colours.push(...colour, 0.8);
  }
  fill(layers.camera, places, colours);
}

// The outlines of the rooms, a little above the floor, and where their names are.
const roomPlaces = new Map();

function drawRooms() {
  const places = [], colours = [], colour = rgb("#2f7fb5");
  roomPlaces.clear();
  for (const { id, outline } of hiddenKinds.has("rooms") ? [] : head.rooms) {
    const middle = new THREE.Vector3();
    outline.forEach((corner, at) => {
      const next = outline[(at + 1) % outline.length];
      places.push(corner[0], corner[1], corner[2] + 0.03, next[0], next[1], next[2] + 0.03);
      colours.push(...colour, 0.9, ...colour, 0.9);
      middle.add(new THREE.Vector3(...corner).divideScalar(outline.length));
    });
    roomPlaces.set(id, middle);
  }
  fill(layers.rooms, places, colours);
}

const roomName = ({ name, sure }) => `${name}${sure ? "" : "?"}`;

// The room in which an object most probably is, and how probable that is.
function roomOf(id) {
  const found = head.rooms.flatMap(room => room.objects.filter(([node]) => node === id)
    .map(([, share]) => [room, share])).sort((a, b) => b[1] - a[1]);
  return found.length ? `${roomName(found[0][0])}, ${percent(found[0][1])}` : null;
}

// Everything that is drawn is between these corners.
const low = new THREE.Vector3(), high = new THREE.Vector3();
let reach = 1, floor = null, fitted = 0, isMoved = false;

function measure() {
  low.set(Infinity, Infinity, Infinity);
  high.set(-Infinity, -Infinity, -Infinity);
  for (const { centre, size } of nodes.values()) {
    const half = Math.hypot(...size) / 2;
    low.min(new THREE.Vector3(...centre).addScalar(-half));
    high.max(new THREE.Vector3(...centre).addScalar(half));
  }
  for (const place of path) {
    low.min(new THREE.Vector3(...place));
    high.max(new THREE.Vector3(...place));
  }
  if (low.x > high.x) { low.set(-1, -1, 0); high.set(1, 1, 1); }
  const extent = high.clone().sub(low);
  reach = Math.max(extent.x, extent.y, extent.z, 0.5);
  [camera.near, camera.far] = [Math.max(0.05, reach / 20000), Math.max(1000, 10 * reach)];
  camera.updateProjectionMatrix();
  // Lines on the floor, a metre apart.
  const cells = Math.min(2 * Math.ceil(reach / 2) + 2, 200);
  if (floor?.cells !== cells) {
    if (floor) { scene.remove(floor); floor.geometry.dispose(); }
    floor = new THREE.GridHelper(cells, cells);
    floor.cells = cells;
    floor.rotateX(Math.PI / 2);
    scene.add(floor);
    recolour();
  }
  floor.position.set(Math.round((low.x + high.x) / 2), Math.round((low.y + high.y) / 2), low.z);
  // A live view follows what grows until the user moves it.
  if (!isMoved && Math.abs(reach - fitted) > 0.03 * fitted) home();
}

function home() {
  fitted = reach;
  isMoved = false;
  controls.target.copy(low).add(high).multiplyScalar(0.5);
  camera.position.copy(controls.target).add(
    new THREE.Vector3(-0.1, -0.85, 0.75).multiplyScalar(reach * Math.max(1, 0.9 / camera.aspect)));
  controls.update();
}

// Behind the camera, looking where it looks.
function follow() {
  if (hiddenKinds.has("follow") || eye === null) return;
  const [, down, forward] = eye.axes.map(axis => new THREE.Vector3(...axis));
  const centre = new THREE.Vector3(...eye.centre);
  controls.target.copy(centre).addScaledVector(forward, 1.5);
  camera.position.copy(centre).addScaledVector(forward, -1.2).addScaledVector(down, -0.6);
  controls.update();
}

function recolour() {
  if (floor === null) return;
  const style = getComputedStyle(document.documentElement);
  floor.material.vertexColors = false;
  floor.material.color.set(style.getPropertyValue("--grid").trim());
  floor.material.needsUpdate = true;
  draw();
}

// --- labels: those that would cover another one are left out; the farther, the paler ---------------

const labels = byId("labels");
const taken = [];
// Of the view, pixels: to ask for them between two labels would arrange the page anew each time.
let viewWidth = 1, viewHeight = 1;

function put(text, place, className, colour) {
  const at = place.clone().project(camera);
  if (at.z > 1 || Math.abs(at.x) > 1.1 || Math.abs(at.y) > 1.1) return;
  const x = (at.x + 1) / 2 * viewWidth, y = (1 - at.y) / 2 * viewHeight;
  // About 6.6 pixels a character: measuring each text would take longer than drawing it.
  const width = 6.6 * text.length + 4, height = 15;
  const box = [x - width / 2, y - height / 2, x + width / 2, y + height / 2];
  if (taken.some(o => box[0] < o[2] && box[2] > o[0] && box[1] < o[3] && box[3] > o[1])) return;
  taken.push(box);
  const label = element("span", className, text);
  label.style.transform = `translate(${x}px, ${y}px) translate(-50%, -50%)`;
  if (!className.includes("strong"))
    label.style.opacity = Math.min(1, Math.max(0.5,
      1.9 - place.distanceTo(camera.position) / camera.position.distanceTo(controls.target)));
  if (colour) label.style.color = colour;
  labels.append(label);
}

const top_ = node => new THREE.Vector3(...node.centre).setZ(node.centre[2] + node.size[2] / 2);

function drawLabels() {
  [viewWidth, viewHeight] = [view.clientWidth, view.clientHeight];
  labels.replaceChildren();
  taken.length = 0;
  if (hiddenKinds.has("labels")) return;
  const first = pointed ?? chosen;
  if (first !== null) {
    put(name(first), top_(nodes.get(first)), "strong");
    for (const [edge, middle] of middles) put(edge.predicate, middle, "predicate strong");
  }
  for (const one of head.rooms)
    if (roomPlaces.has(one.id)) put(roomName(one), roomPlaces.get(one.id), "place");
  for (const node of visibleNodes().sort((a, b) => b.observations - a.observations))
    if (node.id !== first) put(name(node.id), top_(node), node.sure ? "" : "unsure");
  if (first === null)
    for (const [edge, middle] of middles)
      put(edge.predicate, middle, "predicate", head.tints[edge.predicate]);
}

// --- drawing: what changed, at the next picture of the screen ---------------------------------------

const due = new Set();
let isDue = false;

function draw(...parts) {
  parts.forEach(part => due.add(part));
  if (isDue) return;
  isDue = true;
  requestAnimationFrame(() => {
    isDue = false;
    const parts = new Set(due);
    due.clear();
    if (parts.has("all")) measure();
    if (parts.has("room") || cuts() !== drawnCuts) drawRoom();
    else if (parts.has("all") || parts.has("choice")) dimRoom();
    if (parts.has("all") || parts.has("choice")) {
      drawBoxes();
      drawArrows();
      drawPoints();
      drawRooms();
      fillList();
      showCard(pointed ?? chosen);
      showEmpty();
    } else if (parts.has("points")) drawPoints();
    if (parts.has("all") || parts.has("choice") || parts.has("camera")) drawCamera();
    if (parts.has("camera")) follow();
    renderer.render(scene, camera);
    drawLabels();
  });
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
    isMoved = true;
    controls.update();
  }
  draw("choice");
}

// --- the card of an object -----------------------------------------------------------------------

const HINT = matchMedia("(hover: hover)").matches
  ? "Point at a box to see its relations. Click it to keep them, Esc to let go."
  : "Touch a box to see its relations.";
const opened = new Set();  // relations whose reasons are shown

function showCard(id) {
  const card = byId("card");
  if (id === null) {
    card.replaceChildren(element("span", "hint", nodes.size
      ? HINT : ""));
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
    ["in", roomOf(id)],
    ["position", `${node.position.map(value => value.toFixed(2)).join(", ")} m`],
    ["seen in", plural(node.observations, "frame")],
  ]) if (text !== null) facts.append(element("dt", "", term), element("dd", "", text));
  const list = element("ul");
  for (const edge of edges.values())
    if (isOf(edge, id) && showsEdge(edge)) list.append(relationItem(edge, id));
  const title = element("h2", "", name(id)), parts = [title, facts, list];
  if (node.words) parts.splice(1, 0, element("p", "hint", node.words));
  if (id === chosen) {
    const close = element("button", "close", "×");
    close.title = "let go (Esc)";
    close.onclick = () => choose(null);
    title.append(close);
  }
  const cut = element("a", "hint", cutOut.has(id) ? "put it back" : "cut it out");
  cut.title = "without its box, its relations and its part of the room";
  cut.onclick = () => { cutOut.delete(id) || cutOut.add(id); draw("choice"); };
  parts.push(cut);
  if (photos.has(id)) {
    const photo = element("img", "photo");
    photo.alt = "best view of the object";
    photo.src = `${location.pathname}/photo/${id}?${photos.get(id)}`;
    parts.splice(1, 0, photo);
  }
  card.replaceChildren(...parts);
}

const SOURCES = { visual: "seen", prior: "judged by the world model",
  fused: "seen, and judged by the world model", operator: "said by an operator" };

const reasons = new Map();  // of live relations: lines, and when they were asked for

async function reasonsOf(edge) {
  if (edge.why) return edge.why;
  if (!isLive) return ["this page has no more of it; the command `deworldsg explain` has"];
  const old = reasons.get(keyOf(edge));
  if (old && performance.now() - old.at < 1000) return old.lines;
  const asked = { at: performance.now(), lines: fetch(
    `${location.pathname}/why/${edge.subject}/${edge.object}`).then(answer => answer.json()) };
  reasons.set(keyOf(edge), asked);
  return asked.lines;
}

function relationItem(edge, id) {
  const line = element("li"), more = element("details"), key = keyOf(edge);
  const other = edge.subject === id ? edge.object : edge.subject;
  const link = element("a", "", name(other)), summary = element("summary");
  link.onclick = event => { event.preventDefault(); choose(other); };
  const ends = [edge.subject, edge.object].map(end => end === id ? name(end) : link);
  summary.append(ends[0], " ", element("b", "", head.verbs[edge.predicate]), " ", ends[1], " ",
    element("span", "quiet", `${percent(tripletOf(edge))}, ${SOURCES[edge.provenance]}`));
  const show = async () => {
    const lines = await reasonsOf(edge);
    if (more.childElementCount === 1)
      more.append(...lines.map(text => element("div", "hint", text)));
  };
  summary.onclick = () => {  // before it opens or closes
    more.open ? opened.delete(key) : opened.add(key);
    if (!more.open) show();
  };
  more.append(summary);
  more.open = opened.has(key);
  if (more.open) show();
  line.append(more);
  return line;
}

// --- filters and list ----------------------------------------------------------------------------

for (const kind of ["object", "relation"]) {
  const slider = byId(`least-${kind}`), shown = slider.nextElementSibling;
  const apply = () => {
    least[kind] = slider.value / 100;
    shown.textContent = `${slider.value}\u00a0%`;
  };
  slider.oninput = () => { apply(); draw("choice"); };
  apply();
}

function toggle(set, key, colour) {
  const box = element("input");
  box.type = "checkbox";
  box.checked = !set.has(key);
  if (colour) box.style.accentColor = colour;
  box.onchange = () => { box.checked ? set.delete(key) : set.add(key); draw("choice"); };
  return box;
}

function fillPredicates() {
  const counts = new Map();
  for (const edge of edges.values())
    if (!isDouble(edge)) counts.set(edge.predicate, (counts.get(edge.predicate) ?? 0) + 1);
  replaceIfNew(byId("predicates"), [...counts].sort(([a], [b]) => a < b ? -1 : 1),
    ([predicate, count]) => {
      const label = element("label");
      label.append(toggle(hiddenPredicates, predicate, head.tints[predicate]), predicate, " ",
        element("span", "quiet", count));
      return label;
    });
}

// Elements that a user may be about to click are made anew only if their content is another.
function replaceIfNew(parent, values, make) {
  const content = JSON.stringify(values);
  if (parent.content === content) return;
  parent.content = content;
  parent.replaceChildren(...values.map(make));
}

for (const box of document.querySelectorAll("#switches input")) {
  const kind = box.dataset.kind;
  box.checked = !hiddenKinds.has(kind);
  box.onchange = () => {
    box.checked ? hiddenKinds.delete(kind) : hiddenKinds.add(kind);
    if (kind === "points") hasChosenPoints = true;
    if (kind === "camera") {
      byId("camera").hidden = !box.checked || !byId("camera").src;
      tell({ images: box.checked });
    }
    draw("choice", "camera");
  };
}

function fillList() {
  const sought = byId("search").value.trim().toLowerCase(), groups = new Map();
  for (const node of nodes.values())
    if (name(node.id).toLowerCase().includes(sought))
      groups.set(node.label, [...(groups.get(node.label) || []), node]);
  const rows = [...groups.keys()].sort().flatMap(label => [
    { label, count: groups.get(label).length, colour: head.colours[label] },
    ...groups.get(label).map(node => ({ id: node.id, text: name(node.id),
      belief: percent(node.probability), colour: head.colours[label] })),
  ]);
  replaceIfNew(byId("list"), rows, row => row.id === undefined ? classItem(row) : objectItem(row));
  for (const item of document.querySelectorAll("#list li.object")) {
    const id = Number(item.dataset.id);
    item.classList.toggle("chosen", id === chosen);
    item.classList.toggle("off", !showsNode(nodes.get(id)));
  }
  fillPredicates();
}

function classItem({ label, count, colour }) {
  const header = element("li", "class"), text = element("label", "name");
  text.append(toggle(hiddenClasses, label, colour), label);
  header.append(text, element("span", "quiet", count));
  return header;
}

function objectItem({ id, text, belief, colour }) {
  const item = element("li", "object"), dot = element("span", "dot");
  item.dataset.id = id;
  dot.style.background = colour;
  item.append(dot, element("span", "name", text), element("span", "quiet", belief));
  item.onclick = () => choose(id);
  item.onmouseenter = () => { pointed = id; draw("choice"); };
  item.onmouseleave = () => { pointed = null; draw("choice"); };
  return item;
}

byId("search").oninput = () => draw("choice");
// On a phone the panel gives way to the scene until its title is touched.
document.querySelector("header").onclick = () => byId("side").classList.toggle("open");

// --- an empty graph says why ---------------------------------------------------------------------

function showEmpty() {
  byId("empty").hidden = nodes.size > 0;
  if (nodes.size) return;
  const parts = [element("h2", "", "No objects in this graph.")];
  const reasons = Object.entries(head.hidden);
  if (isLive) parts.push(element("p", "", head.why));
  else if (reasons.length) {
    const list = element("ul");
    for (const [reason, count] of reasons) list.append(element("li", "", `${count}: ${reason}`));
    parts.push(element("p", "", "These were detected, and are not in the graph:"), list);
  } else parts.push(element("p", "", "Nothing was detected. The detector may not know what is in " +
    "view, or depth or poses may be missing. The command `deworldsg doctor RECORDING` looks for " +
    "the cause."));
  byId("empty").replaceChildren(...parts);
}

// --- pointer, keys, size -------------------------------------------------------------------------

const caster = new THREE.Raycaster();
let pressed = null;

// Whether a ray meets a box, in the axes of the box.
function meets({ origin, direction }, { centre, axes, size }) {
  let enter = 0, leave = Infinity;
  for (let side = 0; side < 3; side++) {
    const axis = new THREE.Vector3(...axes.slice(3 * side, 3 * side + 3));
    const start = origin.clone().sub(new THREE.Vector3(...centre)).dot(axis);
    const speed = direction.dot(axis), half = Math.max(size[side], 0.005) / 2;
    const [a, b] = [(-half - start) / speed, (half - start) / speed].sort((p, q) => p - q);
    if (Number.isNaN(a)) return false;
    enter = Math.max(enter, a);
    leave = Math.min(leave, b);
  }
  return enter <= leave;
}

function under(event) {
  const frame = renderer.domElement.getBoundingClientRect();
  caster.setFromCamera(new THREE.Vector2(
    2 * (event.clientX - frame.left) / frame.width - 1,
    1 - 2 * (event.clientY - frame.top) / frame.height), camera);
  const hits = hiddenKinds.has("boxes") ? []
    : visibleNodes().filter(node => meets(caster.ray, node));
  // A cup inside the box of a table: the smallest box under the pointer is meant.
  const volume = node => node.size.reduce((a, b) => a * b, 1);
  return hits.length ? hits.reduce((a, b) => volume(b) < volume(a) ? b : a).id : null;
}

renderer.domElement.addEventListener("pointermove", event => {
  if (event.buttons || event.pointerType === "touch") return;
  const id = under(event);
  if (id !== pointed) { pointed = id; draw("choice"); }
});
renderer.domElement.addEventListener("pointerdown", event => {
  pressed = [event.clientX, event.clientY];
});
renderer.domElement.addEventListener("pointerup", event => {
  if (pressed === null) return;
  const moved = Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]);
  if (moved < 5) choose(under(event));
  else isMoved = true;
});
renderer.domElement.addEventListener("wheel", () => { isMoved = true; }, { passive: true });
document.addEventListener("keydown", event => {
  if (event.key !== "Escape") return;
  if (chosen === null && pointed === null) home();
  choose(null);
});
controls.addEventListener("change", () => draw());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);

new ResizeObserver(() => {
  renderer.setPixelRatio(window.devicePixelRatio);
  renderer.setSize(view.clientWidth, view.clientHeight, false);
  renderer.domElement.style.width = renderer.domElement.style.height = "100%";
  camera.aspect = view.clientWidth / Math.max(view.clientHeight, 1);
  camera.updateProjectionMatrix();
  if (!isMoved) home();
  draw();
}).observe(view);

// --- messages: what changed -----------------------------------------------------------------------

function apply(message) {
  if (message.head) head = message.head;
  for (const id of message.removed ?? [])
    for (const map of [nodes, clouds, photos]) map.delete(id);
  for (const [subject, object] of message.removedEdges ?? []) edges.delete(`${subject} ${object}`);
  for (const node of message.nodes ?? []) nodes.set(node.id, node);
  for (const edge of message.edges ?? []) edges.set(keyOf(edge), edge);
  for (const cloud of message.clouds ?? []) clouds.set(cloud.id, pointsOf(cloud));
  for (const id of message.removedClouds ?? []) clouds.delete(id);
  for (const id of message.removedPhotos ?? []) photos.delete(id);
  for (const [id, stamp] of message.photos ?? []) photos.set(id, stamp);
  if (message.path) path = path.slice(0, message.from ?? 0).concat(message.path);
  if (message.camera) eye = message.camera;
  for (const id of message.removed ?? []) cutOut.delete(id);
  if (!nodes.has(chosen)) chosen = null;
  if (!nodes.has(pointed)) pointed = null;
  const count = [...edges.values()].filter(edge => !isDouble(edge)).length;
  byId("title").textContent = `${plural(nodes.size, "object")}, ${plural(count, "relation")}`;
  byId("subtitle").textContent = head.frame_id ? `world frame “${head.frame_id}”` : "";
  if (message.moments) showMoments(message.moments);
  if (message.head || message.nodes || message.removed || message.edges || message.removedEdges)
    draw("all");
  if (message.clouds || message.removedClouds) draw("points");
  if (message.surface) { addToRoom(message.surface); draw("room"); }
  if (message.path || message.camera) draw("camera");
}

function pointsOf({ from, mm }) {
  const steps = new Int16Array(bytesOf(mm).buffer), points = new Float32Array(steps.length);
  for (let at = 0; at < steps.length; at++) points[at] = from[at % 3] + steps[at] / 1000;
  return points;
}

// --- live: the socket, the camera's image, the time -----------------------------------------------

let socket = null, moment = null;
const tell = wish => { if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(wish)); };

function connect() {
  socket = new WebSocket(location.href.split("#")[0].replace(/^http/, "ws"));
  socket.binaryType = "blob";
  socket.onopen = () => {
    // The server begins anew: what it does not send is gone.
    for (const map of [nodes, edges, clouds, photos, cutOut]) map.clear();
    path = [];
    addToRoom({});
    byId("lost").hidden = true;
    tell({ images: !hiddenKinds.has("camera"), moment });
  };
  socket.onmessage = ({ data }) => {
    if (typeof data === "string") { apply(JSON.parse(data)); return; }
    const image = byId("camera"), old = image.src;
    image.src = URL.createObjectURL(data);
    image.hidden = hiddenKinds.has("camera");
    if (old) URL.revokeObjectURL(old);
  };
  socket.onclose = () => {
    byId("lost").hidden = false;
    setTimeout(connect, 2000);
  };
}

function showMoments({ first, last, shown, late_s }) {
  const slider = byId("moment");
  byId("time").hidden = last <= first;
  [slider.min, slider.max] = [first, last];
  if (moment === null) slider.value = last;
  byId("late").textContent = shown === null ? "now" : `${late_s} s ago`;
  byId("newest").hidden = moment === null;
}

function goTo(wanted) {
  moment = wanted;
  byId("newest").hidden = moment === null;
  tell({ moment });
}

byId("moment").oninput = event =>
  goTo(event.target.value === event.target.max ? null : Number(event.target.value));
byId("newest").onclick = () => goTo(null);

document.body.classList.toggle("live", isLive);
if (isLive) connect();
else apply(kept);
draw("all", "camera");
