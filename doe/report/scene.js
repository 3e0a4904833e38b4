"use strict";
// A cell in space (three.js): the arm at a posture, the runs of a plan, tracker and line of sight, measured errors.
// Lengths in mm, z up. It is drawn when something has changed.

const UP = new THREE.Vector3(0, 0, 1), ALONG = new THREE.Vector3(0, 1, 0); // three.js builds what is long along y
const FIELD = 30; // [deg] that is seen from top to bottom
const PARTS = Array.from({ length: 33 }, (_, k) => k / 32); // of a move, at which its path is drawn
const VIEW = { w: [0, 1], s: [0, -1], a: [1, 0], d: [-1, 0] };

function matrix(rows) { return new THREE.Matrix4().set(...rows, 0, 0, 0, 1); }

function vector(three) { return new THREE.Vector3(...three); }

// of the base, of each joint after it moved, and of the measured point, at joint positions q [rad, mm]
function jointFrames(chain, q) {
  const frames = [new THREE.Matrix4()];
  chain.forEach((step, j) => {
    const frame = frames[j].clone().multiply(matrix(step.pose)), motion = new THREE.Matrix4();
    if (step.type === "revolute") motion.makeRotationAxis(vector(step.axis), q[j]);
    else if (step.type) motion.makeTranslation(vector(step.axis).multiplyScalar(q[j]));
    frames.push(frame.multiply(motion));
  });
  return frames;
}

function originOf(frame) { return new THREE.Vector3().setFromMatrixPosition(frame); }

// 1, 2 or 5 times a power of ten that is at most this
function roundNumber(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].find(digit => digit * power <= value * 1.0001) * power;
}

// puts what is 1 long along y between two points
function span(thing, start, end, radius = 1) {
  const way = end.clone().sub(start), length = way.length() || 1e-9;
  thing.position.copy(start).addScaledVector(way, 0.5);
  thing.quaternion.setFromUnitVectors(ALONG, way.divideScalar(length));
  thing.scale.set(radius, length, radius);
  return thing;
}

// a line through points, in place of those that it had
function through(line, points) {
  line.geometry.dispose();
  line.geometry = new THREE.BufferGeometry().setFromPoints(points);
  return line;
}

function numbers(text) { return new Uint16Array(Uint8Array.from(atob(text), letter => letter.charCodeAt(0)).buffer); }

// of a body, as scene.py writes it
function solid({ low, step, vertices, faces }) {
  const geometry = new THREE.BufferGeometry(), corners = Float32Array.from(numbers(vertices), (value, k) => low[k % 3] + step * value);
  geometry.setAttribute("position", new THREE.BufferAttribute(corners, 3));
  geometry.setIndex(new THREE.BufferAttribute(numbers(faces), 1));
  return THREE.toCreasedNormals(geometry, 0.7);
}

class Cell {
  // plan : of the page;  changed() : the reader chose something else to see
  constructor(place, plan) {
    this.data = plan.scene;
    this.chain = this.data.chain;
    this.runs = this.data.postures.map(q => jointFrames(this.chain, q).map(originOf));
    this.box = element("div", place, "", { class: "scene" });
    this.canvas = element("canvas", this.box, "", { tabindex: 0, role: "application", "aria-label": "The arm at the postures of the plan, in three dimensions" });
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true });
    this.scene = new THREE.Scene();
    this.paints = {};
    this.labels = [];
    this.build(plan);
    this.look();
    this.paint();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.paint());
    new ResizeObserver(() => this.fit()).observe(this.box);
    this.fit();
  }

  // a material in a color of the page's style sheet
  color(name, Kind = THREE.MeshLambertMaterial, settings = {}) {
    const key = name + Kind.name + JSON.stringify(settings);
    return (this.paints[key] ??= { name, material: new Kind({ ...settings, transparent: "opacity" in settings }) }).material;
  }

  paint() {
    const style = getComputedStyle(this.box);
    for (const { name, material } of Object.values(this.paints))
      material.color.set(style.getPropertyValue(this.struck && name === "--link" ? "--before" : name).trim());
    this.draw();
  }

  skin(body, near = false) {
    return this.color(near ? "--before" : body.joint ? "--link" : "--cell", THREE.MeshLambertMaterial, { side: THREE.DoubleSide });
  }

  add(thing, parent = this.scene) {
    parent.add(thing);
    return thing;
  }

  line(points, name, settings = {}, Kind = THREE.Line) {
    const material = this.color(name, settings.dashSize ? THREE.LineDashedMaterial : THREE.LineBasicMaterial, settings);
    const line = through(new Kind(new THREE.BufferGeometry(), material), points);
    return this.add(settings.dashSize ? line.computeLineDistances() : line);
  }

  label(text, at) { this.labels.push({ at, sign: element("span", this.box, text, { "aria-hidden": true }) }); }

  build(plan) {
    const { data } = this, points = this.runs.flat(), trackers = data.trackers.map(vector);
    // what is seen at first: the arm in every posture, and trackers and what stands around that are not far from it
    const reach = Math.max(...points.map(point => point.length()), 1);
    this.seen = [...points, ...trackers.filter(one => one.length() < 3 * reach)];
    this.size = reach;
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8090a0, 2.2));
    this.lamp = this.add(new THREE.DirectionalLight(0xffffff, 1.7));
    this.joints = this.chain.map(() => this.add(new THREE.Group())).concat(this.add(new THREE.Group()));
    for (const joint of this.joints) joint.matrixAutoUpdate = false;
    this.meshes = [];
    for (const body of data.bodies) {
      const mesh = this.add(new THREE.Mesh(solid(body), this.skin(body)), this.joints[body.joint]);
      this.meshes.push({ body, mesh });
      mesh.geometry.computeBoundingBox();
      const ends = mesh.geometry.boundingBox, [xs, ys, zs] = ["x", "y", "z"].map(axis => [ends.min[axis], ends.max[axis]]);
      const corners = body.joint ? [] : xs.flatMap(x => ys.flatMap(y => zs.map(z => vector([x, y, z]))));
      this.seen.push(...corners.filter(one => one.length() < 3 * reach));
    }
    this.rod = new THREE.CylinderGeometry(1, 1, 1, 20);
    this.ball = new THREE.SphereGeometry(1, 24, 16);
    const bare = !data.bodies.some(body => body.joint), thick = 0.018 * reach;
    this.rods = this.chain.map((step, j) => {
      const last = j === this.chain.length - 1;
      if (!bare && !last) return null; // bodies show the links, but not what leads to the reflector
      if (bare && !last) this.add(new THREE.Mesh(this.ball, this.color("--joint")), this.joints[j + 1]).scale.setScalar(1.5 * thick);
      return this.add(new THREE.Mesh(this.rod, this.color(bare ? "--link" : "--joint")));
    });
    this.thick = bare ? thick : 0.004 * reach;
    this.reflector = this.add(new THREE.Mesh(this.ball, this.color("--sight")));
    this.reflector.scale.setScalar(Math.max(19.05, 0.013 * reach)); // a ball of 1.5 inches
    this.sights = trackers.map(at => this.line([at, at], "--sight"));
    trackers.forEach((at, k) => this.tracker(at, trackers.length > 1 ? `tracker ${k + 1}` : "tracker"));
    for (const { line, forbidden } of plan.outlines)
      this.line(line.map(vector), forbidden ? "--before" : "--soft", { dashSize: 0.03 * reach, gapSize: 0.02 * reach, opacity: 0.3 });
    this.ground(reach);
    this.others = this.line(points, "--after", { opacity: 0.16 }, THREE.LineSegments);
    this.path = this.line(points, "--after", { opacity: 0.9 });
    this.dots = this.add(new THREE.InstancedMesh(this.ball, this.color("--after", THREE.MeshLambertMaterial, { opacity: 0.55 }), this.runs.length));
    this.dots.frustumCulled = false;
    this.arrows = this.add(new THREE.Group());
  }

  tracker(at, name) {
    const head = this.add(new THREE.Mesh(this.ball, this.color("--sight")));
    head.position.copy(at);
    head.scale.setScalar(0.03 * this.size);
    this.add(span(new THREE.Mesh(this.rod, this.color("--joint")), at, at.clone().addScaledVector(UP, -0.12 * this.size), 0.022 * this.size));
    this.label(name, at.clone().addScaledVector(UP, 0.08 * this.size));
  }

  // a grid at the height of the floor, or of the base where no floor is known; axes at the base
  ground(reach) {
    const mesh = roundNumber(reach / 2.5), count = Math.ceil(1.3 * reach / mesh), far = count * mesh, z = this.data.floor ?? 0, lines = [];
    for (let k = -count; k <= count; k++)
      for (const [x, y] of [[k * mesh, far], [far, k * mesh]])
        lines.push(vector([x, y, z]), vector(x === k * mesh && y === far ? [x, -far, z] : [-far, y, z]));
    this.line(lines, "--line", {}, THREE.LineSegments);
    if (this.data.floor !== null) {
      const floor = this.add(new THREE.Mesh(new THREE.PlaneGeometry(2 * far, 2 * far), this.color("--floor", THREE.MeshBasicMaterial, { opacity: 0.6, side: THREE.DoubleSide, depthWrite: false })));
      floor.position.z = z - 0.002 * reach;
      floor.renderOrder = -1;
    }
    this.label(`grid ${mesh} mm`, vector([far, -far, z]));
    ["x", "y", "z"].forEach((name, k) => {
      const end = new THREE.Vector3().setComponent(k, 0.25 * reach);
      this.line([vector([0, 0, 0]), end], "--soft");
      this.label(name, end.multiplyScalar(1.1));
    });
  }

  // -- what is shown of the plan ---------------------------------------------------------------------------------------
  // the arm at q; in red struck: all of it, near: names of bodies, and of what is a line of sight
  pose(q, struck = false, near = []) {
    const placed = jointFrames(this.chain, q), at = placed.map(originOf), tip = at[at.length - 1];
    this.joints.forEach((joint, j) => joint.matrix.copy(placed[j]));
    this.rods.forEach((rod, j) => rod && span(rod, at[j], at[j + 1], this.thick));
    this.reflector.position.copy(tip);
    this.sights.forEach((line, k) => through(line, [vector(this.data.trackers[k]), tip]));
    for (const { body, mesh } of this.meshes) mesh.material = this.skin(body, near.includes(body.name));
    for (const line of this.sights) line.material = this.color(near.includes("line of sight") ? "--before" : "--sight", THREE.LineBasicMaterial);
    this.struck = struck;
    this.paint();
  }

  // the runs that are kept, in order, and the way from the current one, as joint positions
  show(kept, current, way) {
    const others = kept.filter(run => run !== current).map(run => this.runs[run]);
    through(this.others, others.flatMap(line => line.slice(1).flatMap((point, k) => [line[k], point])));
    const between = way.slice(1).flatMap((to, k) => PARTS.map(part => to.map((q, j) => way[k][j] + part * (q - way[k][j]))));
    through(this.path, between.map(q => originOf(jointFrames(this.chain, q).at(-1))));
    this.dots.count = others.length;
    others.forEach((line, k) => this.dots.setMatrixAt(k, new THREE.Matrix4().makeScale(...Array(3).fill(0.007 * this.size)).setPosition(line.at(-1))));
    this.dots.instanceMatrix.needsUpdate = true;
    this.draw();
  }

  // errors of the models that are wanted, the largest of them about a fifth of the reach long; returns by how much enlarged
  errors(measured, wanted) {
    const shown = measured.models.filter(one => wanted.has(one.kind));
    const largest = Math.max(...(shown.length ? shown : measured.models).flatMap(model => model.arrows.map(arrow => Math.hypot(...arrow))), 1e-9);
    const scale = roundNumber(0.3 * this.size / largest);
    this.arrows.clear();
    for (const model of shown) {
      const paint = this.color(`--${model.kind}`), count = model.arrows.length, place = new THREE.Group();
      const shafts = new THREE.InstancedMesh(this.rod, paint, count), heads = new THREE.InstancedMesh(this.cone ??= new THREE.ConeGeometry(1, 1, 12), paint, count);
      model.arrows.forEach((arrow, k) => {
        const start = vector(measured.at[k]), way = vector(arrow).multiplyScalar(scale), end = start.clone().add(way);
        const neck = start.clone().addScaledVector(way, Math.max(0, 1 - 0.022 * this.size / (way.length() || 1)));
        for (const [set, from, to, width] of [[shafts, start, neck, 0.002], [heads, neck, end, 0.0075]]) {
          span(place, from, to, width * this.size).updateMatrix();
          set.setMatrixAt(k, place.matrix);
        }
      });
      for (const set of [shafts, heads]) { set.frustumCulled = false; this.add(set, this.arrows); }
    }
    this.paint();
    return scale;
  }

  // -- the view --------------------------------------------------------------------------------------------------------
  look() {
    this.camera = new THREE.PerspectiveCamera(FIELD, 1, this.size / 50, this.size * 60);
    this.camera.up.copy(UP);
    this.controls = new THREE.OrbitControls(this.camera, this.canvas);
    Object.assign(this.controls, { minDistance: this.size / 5, maxDistance: this.size * 20 });
    this.controls.addEventListener("start", () => { this.moved = true; });
    this.controls.addEventListener("change", () => this.draw());
    // a finger that moves up or down scrolls the page; what it turned before that was clear is turned back
    this.canvas.style.touchAction = "pan-y";
    let before;
    this.canvas.addEventListener("pointerdown", () => { before = this.camera.position.clone(); });
    this.canvas.addEventListener("pointercancel", () => { this.camera.position.copy(before); this.controls.update(); });
    // a wheel scrolls the page, too, until the picture has been clicked
    this.box.addEventListener("wheel", event => { if (document.activeElement !== this.canvas) event.stopPropagation(); }, { capture: true });
  }

  // the first view: as near as shows all that is to be seen
  home() {
    this.moved = false;
    const [elevation, azimuth] = this.data.view.map(angle => angle * Math.PI / 180), back = new THREE.Vector3();
    back.set(Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation));
    const right = UP.clone().cross(back).normalize(), over = back.clone().cross(right), high = Math.tan(FIELD * Math.PI / 360) * 0.9;
    const center = [right, over].reduce((sum, axis) => {
      const along = this.seen.map(point => point.dot(axis));
      return sum.addScaledVector(axis, (Math.min(...along) + Math.max(...along)) / 2);
    }, new THREE.Vector3());
    const distances = this.seen.map(point => {
      const way = point.clone().sub(center);
      return way.dot(back) + Math.max(Math.abs(way.dot(right)) / this.camera.aspect, Math.abs(way.dot(over))) / high;
    });
    this.controls.target.copy(center);
    this.camera.position.copy(center).addScaledVector(back, Math.max(...distances));
    this.controls.update();
    this.draw();
  }

  // the run whose measured point is where a reader clicked, at most 15 pixels away
  runAt({ offsetX, offsetY }) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const away = this.runs.map(points => {
      const { x, y } = points.at(-1).clone().project(this.camera);
      return Math.hypot((x + 1) * width / 2 - offsetX, (1 - y) * height / 2 - offsetY);
    });
    const nearest = Math.min(...away);
    return nearest <= 15 ? away.indexOf(nearest) : undefined;
  }

  // keys of the view alone; whether it was one
  key(event) {
    const { controls } = this, turn = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    const way = VIEW[event.key.toLowerCase()];
    if (event.ctrlKey || event.metaKey || event.altKey) return false;
    if (event.key === "0") { this.home(); return true; }
    if (event.shiftKey && turn) { controls.rotateLeft(turn[0] * 0.15); controls.rotateUp(turn[1] * 0.15); }
    else if (way) controls.pan(way[0] * 30, way[1] * 30);
    else if (event.key === "+" || event.key === "=") controls.dollyIn(1.15);
    else if (event.key === "-") controls.dollyOut(1.15);
    else return false;
    return (this.moved = true);
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.box;
    if (!width || !height) return; // not shown
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.moved) this.draw();
    else this.home();
  }

  draw() {
    this.waiting ??= requestAnimationFrame(() => {
      this.waiting = undefined;
      this.lamp.position.copy(this.camera.position).addScaledVector(UP, this.size);
      this.renderer.render(this.scene, this.camera);
      const { clientWidth: width, clientHeight: height } = this.box;
      for (const { at, sign } of this.labels) {
        const { x, y, z } = at.clone().project(this.camera);
        const left = (x + 1) * width / 2 - sign.offsetWidth / 2, top = (1 - y) * height / 2 - sign.offsetHeight / 2;
        sign.style.visibility = z > 1 || Math.abs(x) > 1 || Math.abs(y) > 1 ? "hidden" : "visible";
        sign.style.transform = `translate(${Math.min(Math.max(left, 2), width - sign.offsetWidth - 2)}px, ${top}px)`;
      }
    });
  }
}
