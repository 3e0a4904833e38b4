"use strict";
// A plan that is stepped through, reordered and cut, with log det M' of what is left. Text is never read as markup.

const KEYS = "Tap or click a run to select it; the buttons above act on the selected run. Keys in the table: " +
  "↑ and ↓, Page Up, Page Down, Home and End select; Alt with ↑ or ↓ moves the run; Delete strikes it out or puts it back. " +
  "Without it: the D-efficiency that is left without this run.";
const KEYS_IN_SPACE = " Click a point in the picture to select its run; drag to turn the view, with two fingers or the right button to move it; pinch, or click and use the wheel, " +
  "to zoom. Keys in the picture: ← and → step, Space plays, Delete strikes out; Shift with an arrow turns the view, W, A, S and D " +
  "move it, + and − zoom, 0 goes back to the first view.";
const [PLAY, PAUSE] = ["▶ Play", "❚❚ Pause"];
const SPEED = { revolute: Math.PI / 2, prismatic: 300 }; // a second, of the moves that are played

function element(name, parent, text = "", attributes = {}, made = document.createElement(name)) {
  made.textContent = text;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  parent.append(made);
  return made;
}

function shape(name, parent, attributes) {
  return element(name, parent, "", attributes, document.createElementNS("http://www.w3.org/2000/svg", name));
}

// p x p, its lower half: sum of B^T B over runs plus the precisions of the prior
function information(plan, runs) {
  const total = plan.precisions.map((value, i) => {
    const row = new Float64Array(plan.parameters);
    row[i] = value;
    return row;
  });
  for (const run of runs) add(total, plan.jacobians[run], 1);
  return total;
}

// adds a run's B^T B, or with -1 takes it away
function add(total, jacobian, sign) {
  const p = total.length;
  for (let start = 0; start < jacobian.length; start += p)
    for (let i = 0; i < p; i++)
      for (let k = 0; k <= i; k++) total[i][k] += sign * jacobian[start + i] * jacobian[start + k];
  return total;
}

// log det of a symmetric matrix by Cholesky, of which the lower half is read and overwritten; -Infinity: singular
function logDet(matrix) {
  const largest = matrix.map((row, i) => row[i]);
  let sum = 0;
  for (let i = 0; i < matrix.length; i++) {
    for (let k = 0; k <= i; k++) {
      let value = matrix[i][k];
      for (let l = 0; l < k; l++) value -= matrix[i][l] * matrix[k][l];
      if (k < i) matrix[i][k] = value / matrix[k][k];
      else if (value <= 1e-13 * largest[i]) return -Infinity;
      else { matrix[i][i] = Math.sqrt(value); sum += Math.log(value); }
    }
  }
  return sum;
}

// a plan by its runs: rows of its file between them are way-points, which belong to the move to the run after them and
// are kept as long as the run before it stays the same
function byRun(plan) {
  const { runs, scene } = plan, at = rows => runs.map(row => rows[row]);
  const before = rows => runs.map((row, run) => rows.slice((runs[run - 1] ?? -1) + 1, row));
  Object.assign(plan, { ways: before(plan.rows), rows: at(plan.rows), via: before(plan.postures), postures: at(plan.postures) });
  if (scene) Object.assign(scene, { via: before(scene.postures), postures: at(scene.postures) });
  return plan;
}

class Steps {
  constructor(place, plan) {
    this.plan = plan;
    this.turn = 30;
    this.whole = logDet(information(plan, plan.rows.keys()));
    [this.left, this.right] = [element("div", place), element("div", place)];
    this.keys = element("p", place, KEYS, { class: "keys", id: `${place.dataset.plan}-keys` });
    this.runs = element("div", place, "", { class: "runs scroll" });
    this.reset();
    this.build();
    this.show();
  }

  reset() {
    this.order = [...this.plan.rows.keys()];
    this.struck = new Set();
    this.at = 0;
  }

  get kept() { return this.order.filter(run => !this.struck.has(run)); }

  build() {
    const names = { role: "img", "aria-label": "The arm at the postures of the plan" };
    this.picture = shape("svg", this.left, { class: "still", viewBox: "0 0 400 320", ...names });
    if (this.plan.scene) this.space();
    this.where = element("p", this.left, "", { class: "where", "aria-live": "polite" });
    const buttons = element("div", this.left, "", { class: "buttons" });
    this.button(buttons, "◀ Back", () => this.step(-1));
    this.button(buttons, "Step ▶", () => this.step(1));
    if (this.cell) this.playing = this.button(buttons, PLAY, () => this.play());
    this.button(buttons, "▲ Earlier", () => this.move(this.at, -1));
    this.button(buttons, "▼ Later", () => this.move(this.at, 1));
    this.striking = this.button(buttons, "", () => this.strike(this.order[this.at]));
    if (this.plan.points[0][0].length === 3) {
      const label = element("label", buttons, "Turn the view ", { class: "still" });
      const slider = element("input", label, "", { type: "range", min: 0, max: 360, value: this.turn });
      slider.addEventListener("input", () => { this.turn = Number(slider.value); this.draw(); });
    }
    if (this.cell && this.plan.scene.errors.length) this.errors(element("fieldset", this.left));
    this.figures = element("dl", this.right, "", { "aria-live": "polite" });
    const more = element("div", this.right, "", { class: "buttons" });
    this.button(more, "Download the edited plan (CSV)", () => this.download());
    this.button(more, "Undo all", () => { this.reset(); this.show(); });
    this.table();
  }

  // the cell in three dimensions, over the drawing, which stands in for it in print and where there is no WebGL
  space() {
    this.turn = (this.plan.scene.view[1] + 450) % 360; // the drawing from the same side
    if (!document.createElement("canvas").getContext("webgl2")) return;
    const place = this.left.parentElement;
    this.cell = new Cell(this.left, this.plan);
    place.classList.add("live");
    this.keys.textContent += KEYS_IN_SPACE;
    const { canvas } = this.cell;
    canvas.setAttribute("aria-describedby", this.keys.id);
    canvas.addEventListener("keydown", event => (this.cell.key(event) ? event.preventDefault() : this.key(event)));
    canvas.addEventListener("webglcontextlost", () => place.classList.remove("live"));
    let from;
    canvas.addEventListener("pointerdown", event => { from = [event.offsetX, event.offsetY]; });
    canvas.addEventListener("click", event => {
      const run = Math.hypot(event.offsetX - from[0], event.offsetY - from[1]) < 5 ? this.cell.runAt(event) : undefined;
      if (run !== undefined) { this.at = this.order.indexOf(run); this.show(); }
    });
  }

  // which errors are shown as arrows, of which measurements
  errors(box) {
    const every = this.plan.scene.errors, wanted = new Set(["before", "after"]);
    element("legend", box, "Measured errors");
    const chosen = element("select", box, "", { "aria-label": "Measurements" });
    every.forEach(({ name, rows, at }, k) => element("option", chosen, `${name}, ${rows} rows${rows > at.length ? `, of which ${at.length}` : ""}`, { value: k }));
    const kinds = element("div", box), scale = element("p", box, "", { "aria-live": "polite" });
    const show = () => { scale.textContent = `Arrows: ${this.cell.errors(every[chosen.value], wanted)} times as long as the errors.`; };
    const choose = () => {
      kinds.replaceChildren();
      for (const { kind, name, rms } of every[chosen.value].models) {
        const label = element("label", kinds, "", { class: kind }), tick = element("input", label, "", { type: "checkbox" });
        label.append(` ${kind}: ${name}, RMS ${rms.toPrecision(3)} mm`);
        tick.checked = wanted.has(kind);
        tick.addEventListener("change", () => { wanted[tick.checked ? "add" : "delete"](kind); show(); });
      }
      show();
    };
    chosen.addEventListener("change", choose);
    choose();
  }

  // place of the next run that is kept, -1: there is none
  get next() { return this.order.findIndex((run, place) => place > this.at && !this.struck.has(run)); }

  // whether the move to a place among the runs that are kept is that of the file, which its way-points belong to
  follows(place) { return (this.kept[place - 1] ?? -1) === this.kept[place] - 1; }

  // joint positions from the current run to the next one
  get way() {
    const { postures, via } = this.plan.scene, from = this.order[this.at], to = this.order[this.next];
    return to === undefined ? [] : [postures[from], ...(to === from + 1 ? via[to] : []), postures[to]];
  }

  // plays the moves from the current run on, or from the first one; once more: pauses
  async play() {
    const playing = this.playing.textContent === PLAY;
    this.pause();
    if (!playing) return;
    if (this.next < 0) { this.at = -1; this.at = Math.max(this.next, 0); this.show(); }
    const mine = this.played = {}, types = this.plan.scene.chain.map(step => step.type);
    this.playing.textContent = PAUSE;
    while (this.next >= 0) {
      const way = this.way;
      for (let k = 1; k < way.length; k++) {
        const [from, to] = [way[k - 1], way[k]], start = performance.now();
        const seconds = Math.max(...from.map((q, j) => Math.abs(to[j] - q) / SPEED[types[j]]), 0.2);
        for (let part = 0; part < 1;) {
          await new Promise(requestAnimationFrame);
          if (this.played !== mine) return;
          part = Math.min((performance.now() - start) / (1000 * seconds), 1);
          this.cell.pose(from.map((q, j) => q + part * (to[j] - q)));
        }
      }
      this.at = this.next;
      this.show(true);
      await new Promise(after => setTimeout(after, 400)); // it is measured
      if (this.played !== mine) return;
    }
    this.pause();
  }

  pause() {
    this.played = null;
    if (this.playing) this.playing.textContent = PLAY;
  }

  // one tab stop: the current row has the focus (the grid of the ARIA Authoring Practices, with roving tabindex)
  table() {
    const about = { "aria-label": "Runs", "aria-describedby": this.runs.previousElementSibling.id };
    const table = element("table", this.runs, "", { role: "grid", ...about });
    const row = element("tr", element("thead", table, "", { role: "rowgroup" }), "", { role: "row" });
    this.headings = ["place", "run", ...this.plan.joints, "without it"];
    for (const name of this.headings) element("th", row, name, { scope: "col", role: "columnheader" });
    this.body = element("tbody", table, "", { role: "rowgroup" });
    this.body.addEventListener("keydown", event => this.key(event));
  }

  button(parent, text, action) {
    const made = element("button", parent, text, { type: "button" });
    made.addEventListener("click", action);
    return made;
  }

  // keys of the table: they reach it only from its current row
  key(event) {
    if (event.ctrlKey || event.metaKey) return;
    const by = { ArrowDown: 1, ArrowUp: -1, PageDown: 10, PageUp: -10, Home: -Infinity, End: Infinity,
      ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (event.altKey && Math.abs(by) === 1) this.move(this.at, by);
    else if (event.altKey) return;
    else if (by) this.step(by);
    else if (event.key === " " && this.cell) this.play();
    else if (event.key === "Delete" || event.key === "Backspace") this.strike(this.order[this.at]);
    else return;
    event.preventDefault();
  }

  step(by) {
    this.at = Math.min(Math.max(this.at + by, 0), this.order.length - 1);
    this.show();
  }

  move(place, by) {
    const to = place + by;
    if (to < 0 || to >= this.order.length) return;
    [this.order[place], this.order[to]] = [this.order[to], this.order[place]];
    this.at = to;
    this.show();
  }

  strike(run) {
    if (!this.struck.delete(run)) this.struck.add(run);
    this.at = this.order.indexOf(run);
    this.show();
  }

  // share of the whole plan's information that is left: (det / det of the whole)^(1/p)
  efficiency(matrix) { return Math.exp((logDet(matrix) - this.whole) / this.plan.parameters); }

  show(playing = false) {
    if (!playing) this.pause();
    const inside = this.body.contains(document.activeElement);
    this.draw();
    this.list();
    this.summary();
    const row = this.body.children[this.at], top = row.offsetTop, box = this.runs;
    if (inside) row.focus({ preventScroll: true });
    if (top < box.scrollTop + 40 || top > box.scrollTop + box.clientHeight - 40) box.scrollTop = top - box.clientHeight / 2;
  }

  summary() {
    const kept = this.kept, p = this.plan.parameters, total = information(this.plan, kept);
    const efficiency = this.efficiency(total.map(row => row.slice()));
    const left = logDet(total), perRun = left - p * Math.log(kept.length);
    const facts = { "runs": `${kept.length} of ${this.plan.rows.length}`, "log det M'": perRun.toFixed(7) };
    if (Number.isFinite(perRun)) {
      facts["log det lost, all runs together"] = (this.whole - left).toFixed(7);
      facts["D-efficiency against the whole plan"] = efficiency.toFixed(4);
    } else facts["log det M'"] = "not every parameter can be identified";
    if (this.plan.joints.every(name => name.endsWith("[deg]"))) facts["joint travel"] = `${this.travel(kept).toFixed(1)} deg`;
    const near = kept.filter(run => this.plan.near[run].length).length;
    if (near) facts["runs with bodies too close"] = near;
    const moves = kept.filter((run, place) => place && !this.follows(place)).length;
    if (this.plan.scene && moves) facts["new moves, not checked"] = moves;
    const text = JSON.stringify(facts);
    if (text === this.summarized) return; // or it would be read aloud again
    this.summarized = text;
    this.figures.replaceChildren();
    for (const [name, value] of Object.entries(facts)) {
      element("dt", this.figures, name);
      element("dd", this.figures, value);
    }
  }

  // sum over the moves of the largest joint travel
  travel(runs) {
    const stops = runs.flatMap((run, place) => [...(this.follows(place) ? this.plan.via[run] : []), this.plan.postures[run]]);
    const moves = stops.slice(1).map((to, k) => Math.max(...to.map((angle, j) => Math.abs(angle - stops[k][j]))));
    return moves.reduce((sum, move) => sum + move, 0);
  }

  list() {
    const total = information(this.plan, this.kept);
    const without = run => {
      const left = this.efficiency(add(total.map(row => row.slice()), this.plan.jacobians[run], -1));
      return Number.isFinite(left) ? left.toFixed(3) : "-";
    };
    this.body.replaceChildren();
    this.order.forEach((run, place) => {
      const struck = this.struck.has(run), current = place === this.at;
      const states = { role: "row", tabindex: current ? 0 : -1, "aria-selected": current };
      const row = element("tr", this.body, "", states);
      row.className = (struck ? "struck" : "") + (current ? " current" : "") + (this.plan.near[run].length ? " near" : "");
      row.addEventListener("click", () => { row.focus(); this.at = place; this.show(); });
      const left = struck ? "struck out" : without(run);
      const figures = [place + 1, run + 1, ...this.plan.postures[run].map(angle => angle.toFixed(2)), left];
      figures.forEach(figure => element("td", row, String(figure), { role: "gridcell" }));
    });
  }

  // across and up of a point, in space from the side, turned about the vertical
  seen(point) {
    if (point.length === 2) return [point[0], point[1]];
    const angle = this.turn * Math.PI / 180, tilt = 0.38;
    const across = Math.cos(angle) * point[0] + Math.sin(angle) * point[1];
    const depth = -Math.sin(angle) * point[0] + Math.cos(angle) * point[1];
    return [across, Math.cos(tilt) * point[2] + Math.sin(tilt) * depth];
  }

  draw() {
    const { points, outlines } = this.plan, flat = line => line.map(point => this.seen(point));
    const lines = points.map(flat), around = outlines.map(one => flat(one.line));
    const every = lines.flat(); // what constrains the arm may be far larger, and is cut off
    const [low, high] = [Math.min, Math.max].map(best => [0, 1].map(axis => best(...every.map(point => point[axis]), 0)));
    const scale = Math.min(360 / (high[0] - low[0] || 1), 280 / (high[1] - low[1] || 1));
    const place = point => [0, 1].map(axis => (axis ? -1 : 1) * scale * (point[axis] - (low[axis] + high[axis]) / 2) + (axis ? 160 : 200));
    const path = line => line.map(point => place(point).map(value => value.toFixed(1)).join()).join(" ");
    const draw = (line, attributes) => shape("polyline", this.picture, { points: path(line), fill: "none", ...attributes });
    this.picture.replaceChildren();
    around.forEach((line, k) => draw(line, { stroke: outlines[k].forbidden ? "var(--before)" : "var(--soft)", "stroke-dasharray": "4 3" }));
    const current = this.order[this.at];
    this.order.forEach((run, k) => {
      if (run === current || this.struck.has(run)) return;
      draw(lines[run], { stroke: "var(--after)", "stroke-width": 1, opacity: k < this.at ? 0.45 : 0.15 });
    });
    const color = this.struck.has(current) ? "var(--before)" : "var(--after)";
    draw(lines[current], { stroke: color, "stroke-width": 3, "stroke-linejoin": "round" });
    lines[current].forEach((point, k) => {
      const [cx, cy] = place(point), last = k === lines[current].length - 1;
      shape("circle", this.picture, { cx, cy, r: last ? 5 : 3, fill: color });
    });
    const [x, y] = place(lines[current][0]);
    shape("rect", this.picture, { x: x - 5, y: y - 5, width: 10, height: 10, fill: "var(--ink)" });
    const struck = this.struck.has(current);
    const near = this.plan.near[current];
    this.where.textContent = `Run ${current + 1}, place ${this.at + 1} of ${this.order.length}${struck ? ", struck out" : ""}`;
    if (near.length) element("span", this.where, `: ${near.map(one => one.text).join("; ")}`, { class: "near" });
    this.striking.textContent = struck ? "Put back" : "Strike out";
    if (!this.cell) return;
    this.cell.pose(this.plan.scene.postures[current], struck, near.flatMap(one => one.bodies));
    this.cell.show(this.kept, current, this.way);
  }

  get csv() {
    const quoted = cell => (/[",\r\n]/.test(cell) ? `"${cell.replaceAll('"', '""')}"` : cell);
    const { columns, ways, rows } = this.plan;
    const runs = this.kept.flatMap((run, k) => (this.follows(k)
      ? [...ways[run].map(row => ["", ...row]), [String(k + 1), ...rows[run]]]
      // how the joints come to it by another move, the file does not know
      : [[String(k + 1), ...rows[run].map((cell, j) => (columns[j].startsWith("direction") ? "" : cell))]]));
    const lines = [["run", ...columns], ...runs];
    const comment = this.plan.comment ? this.plan.comment + "\n" : "";
    return comment + lines.map(line => line.map(quoted).join(",") + "\n").join("");
  }

  download() {
    const link = element("a", document.body, "", { download: this.plan.file });
    link.href = URL.createObjectURL(new Blob([this.csv], { type: "text/csv" }));
    link.click();
    link.remove();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }
}

const plans = [...document.querySelectorAll("[data-plan]")].map(place => {
  place.replaceChildren();
  return new Steps(place, byRun(JSON.parse(document.getElementById(place.dataset.plan).textContent)));
});

// all of a printed page is to be read
const folded = [...document.querySelectorAll("details")];
let opened = [];
window.addEventListener("beforeprint", () => { opened = folded.filter(one => !one.open); opened.forEach(one => { one.open = true; }); });
window.addEventListener("afterprint", () => opened.forEach(one => { one.open = false; }));
