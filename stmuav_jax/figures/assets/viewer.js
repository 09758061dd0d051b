'use strict';
// The page: scenes of one or two runs, controls, and plots that follow the time.

const content = JSON.parse(document.getElementById('data').textContent);
const element = (id) => document.getElementById(id);
const make = (tag, parent, properties = {}) => parent.appendChild(Object.assign(document.createElement(tag), properties));
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const words = (name) => name.replaceAll('_', ' ');
const short = (x) => Number(x.toPrecision(2)).toString();

const machines = content.runs.map((run) => new Machine(run));
const start = Math.min(...machines.map((m) => m.motion.start));
const end = Math.max(...machines.map((m) => m.motion.end));
const state = { time: start, playing: false, speed: 1, frames: 0, rate: 0, dirty: true, follow: false, told: 0 };

// --- scenes

const scenes = machines.map((machine) => {
  const scene = new L.Scene();
  const sky = new L.HemisphereLight('#ffffff', '#aab0ba', 2.2);
  sky.position.set(0, 0, 1);
  scene.add(machine.root, sky);
  return scene;
});
const size = Math.max(...machines.map((m) => m.size));
const camera = new L.PerspectiveCamera(35, 1, size / 200, 2000 * size);
camera.up.set(0, 0, 1);
const lamp = new L.DirectionalLight('#ffffff', 1.6);
const floorOf = machines.map(ground);
let renderer = null;
try {
  renderer = new L.WebGLRenderer({ canvas: document.querySelector('canvas'), antialias: !drawnInSoftware() });
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  renderer.setScissorTest(true);
} catch (error) {
  element('trouble').hidden = false;
  element('trouble').textContent = 'This browser offers no WebGL, so that the mechanism cannot be drawn; '
    + 'the plots work. Switch on hardware acceleration, or open the page in another browser.';
}
// Smooth edges cost a software renderer a quarter of its frames.
function drawnInSoftware() {
  const probe = document.createElement('canvas').getContext('webgl2');
  const about = probe && probe.getExtension('WEBGL_debug_renderer_info');
  const name = about ? probe.getParameter(about.UNMASKED_RENDERER_WEBGL) : '';
  if (probe) probe.getExtension('WEBGL_lose_context').loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

const controls = new L.OrbitControls(camera, document.querySelector('canvas'));
controls.addEventListener('change', () => { state.dirty = true; });

// Grid below the machine, as wide as its way; lines in short pieces, as long ones that pass behind
// the camera are lost in some software renderers.
function ground(machine) {
  const box = machine.bounds(), way = machine.wayBounds().getSize(new L.Vector3());
  const width = 2 * Math.max(way.x, way.y) + 5 * machine.size, rough = width / 50;
  const decade = 10 ** Math.floor(Math.log10(rough));
  const step = decade * [1, 2, 5, 10].find((k) => k * decade >= rough);
  const half = 4 * Math.ceil(width / step / 8), piece = half / 4, points = [];
  for (let a = -half; a <= half; a++) {
    for (let b = -half; b < half; b += piece) points.push(a, b, 0, a, b + piece, 0, b, a, 0, b + piece, a, 0);
  }
  const geometry = new L.BufferGeometry().setAttribute('position', new L.Float32BufferAttribute(points, 3));
  const grid = new L.LineSegments(geometry.scale(step, step, step), new L.LineBasicMaterial());
  const middle = machine.wayBounds().getCenter(new L.Vector3());
  grid.position.set(step * Math.round(middle.x / step), step * Math.round(middle.y / step),
    box.min.z - 0.02 * machine.size);
  machine.root.add(grid);
  return { grid, step };
}

function paintGround() {
  for (const { grid } of floorOf) grid.material.color.set(css('--grid'));
  if (renderer) renderer.setClearColor(css('--sky'));
  state.dirty = true;
}

// Directions from which the presets look; the distance shows all of the machine, of its mechanism
// without the rotors' body, or of its whole way.
const VIEWS = {
  'three-quarter': [1, -1.35, 0.75], 'front': [0, -1, 0], 'side': [1, 0, 0], 'top': [0, -0.001, 1],
  'from below': [0.6, -0.9, -0.8], 'mechanism': [1, -1.35, 0.6], 'whole way': [1, -1.35, 0.75],
};

function look(name) {
  const whole = name === 'whole way', box = new L.Box3();
  follow(!whole && travelling);
  for (const machine of machines) {
    machine.root.position.copy(shift(machine));
    box.union(whole ? machine.wayBounds() : machine.bounds(name === 'mechanism'));
  }
  const radius = 0.5 * box.getSize(new L.Vector3()).length(), half = Math.tan(0.5 * camera.fov * Math.PI / 180);
  box.getCenter(controls.target);
  camera.position.set(...VIEWS[name]).setLength(0.95 * radius / half / Math.min(1, camera.aspect)).add(controls.target);
  controls.update();
  state.dirty = true;
}

// A machine that travels is followed: its scene moves back by the way of its first watched body.
const travelling = machines.some((m) => m.wayBounds().getSize(new L.Vector3()).length() > 3 * m.size && m.run.watch.length);

function shift(machine) {
  const out = new L.Vector3();
  if (!state.follow) return out;
  const { motion } = machine, body = machine.index(machine.run.watch[0]);
  motion.vector(motion.positions, motion.bodies, body, motion.locate(state.time), out);
  return out.sub(motion.vector(motion.positions, motion.bodies, body, [0, 0], new L.Vector3())).negate();
}

function follow(on) {
  state.follow = on;
  element('shown').querySelector('[name=follow]').checked = on;
  state.dirty = true;
}

function draw() {
  machines.forEach((machine) => {
    machine.update(state.time);
    machine.root.position.copy(shift(machine));
  });
  if (renderer) {
    const canvas = renderer.domElement, width = canvas.clientWidth, height = canvas.clientHeight;
    const share = width / machines.length;
    lamp.position.copy(camera.position).sub(controls.target).applyAxisAngle(UP, 0.5);
    machines.forEach((machine, k) => {
      scenes[k].add(lamp);
      renderer.setViewport(k * share, 0, share, height);
      renderer.setScissor(k * share, 0, share, height);
      renderer.render(scenes[k], camera);
    });
    element('names').hidden = !named.bodies && !named.joints;
    if (!element('names').hidden) placeNames(share, height);
  }
  plots.forEach((plot) => plot.follow());
  // laying the page out again costs as much as the scene: ten times a second are enough for the eye
  if (!state.playing || performance.now() - state.told > 100) tell();
  state.dirty = false;
}

function tell() {
  element('scrub').value = state.time;
  element('time').textContent = `${state.time.toFixed(3)} of ${short(end)} s`;
  state.told = performance.now();
}

function resize() {
  const canvas = document.querySelector('canvas');
  const width = canvas.parentElement.clientWidth, height = canvas.parentElement.clientHeight;
  camera.aspect = width / machines.length / height;
  camera.updateProjectionMatrix();
  if (renderer) renderer.setSize(width, height, false);
  plots.forEach((plot) => plot.fit());
  state.dirty = true;
}

// --- names of bodies and joints beside them

const named = { bodies: false, joints: false };
const labels = machines.map((machine) => [
  ...machine.run.bodies.map((body) => ({ of: 'bodies', text: words(body.name),
    at: (v) => v.copy(machine.bodies.get(body.name).position) })),
  ...machine.run.joints.map((joint) => ({ of: 'joints', text: joint.name, at: (v) => machine.point(joint, 'j', v) })),
].map((label) => ({ ...label, tag: make('span', element('names'), { textContent: label.text, className: label.of }) })));

function placeNames(share, height) {
  const place = new L.Vector3();
  labels.forEach((own, k) => own.forEach(({ of, at, tag }) => {
    at(place).add(machines[k].root.position).project(camera);
    const x = (0.5 + 0.5 * place.x) * share, inside = named[of] && place.z < 1 && x > 0 && x < share;
    tag.style.display = inside ? '' : 'none';
    tag.style.transform = `translate(${k * share + x + 6}px, ${(0.5 - 0.5 * place.y) * height}px)`;
  }));
}

// --- plots

const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3]];

class Plot {
  constructor(box, chosen) {
    this.select = box.querySelector('select');
    this.box = box.lastElementChild;
    const titles = [...new Set(content.runs.flatMap((run) => run.curves.map((each) => each.title)))];
    titles.forEach((title) => make('option', this.select, { textContent: title }));
    this.select.value = titles[Math.min(chosen(titles), titles.length - 1)];
    this.select.onchange = () => this.build();
    this.build();
  }

  build() {
    if (this.plot) this.plot.destroy();
    const series = [{ label: 't' }], tables = [];
    content.runs.forEach((run, r) => {
      const found = run.curves.find((each) => each.title === this.select.value);
      if (!found) return;
      tables.push([Array.from(machines[r].motion.times), ...found.curves.map((c) => Array.from(decoded(c.values, Float32Array)))]);
      found.curves.forEach((c, k) => series.push({
        label: content.runs.length > 1 ? `${c.label} (${'AB'[r]})` : c.label,
        stroke: k % 8 === 7 ? () => css('--ink') : PALETTE[k % 8], width: 1.6, points: { show: false },
        dash: content.runs.length > 1 ? DASHES[r] : DASHES[Math.floor(k / 2) % 4], spanGaps: true,
      }));
    });
    const axis = { stroke: () => css('--faint'), grid: { stroke: () => css('--line'), width: 1 },
      ticks: { stroke: () => css('--line') }, font: '11px system-ui, DejaVu Sans, sans-serif' };
    this.plot = new L.uPlot({ width: 300, height: 150, series, scales: { x: { time: false } },
      cursor: { drag: { x: false, y: false }, points: { show: false }, y: false, x: false },
      legend: { live: false, markers: { width: 2 } },
      axes: [{ ...axis, label: 'time [s]', labelSize: 16, size: 26, labelFont: axis.font }, { ...axis, size: 52 }],
    }, L.uPlot.join(tables), this.box);
    this.now = make('div', this.plot.over, { className: 'now' });
    const seekHere = (event) => {
      if (event.type === 'pointermove' && !event.buttons) return;
      seek(this.plot.posToVal(event.clientX - this.plot.over.getBoundingClientRect().left, 'x'));
    };
    this.plot.over.addEventListener('pointerdown', seekHere);
    this.plot.over.addEventListener('pointermove', seekHere);
    this.fit();
  }

  fit() {
    const legend = this.plot.root.querySelector('.u-legend');
    const height = Math.max(90, this.box.clientHeight - (legend ? legend.offsetHeight : 0));
    this.plot.setSize({ width: this.box.clientWidth, height });
    this.follow();
  }

  follow() { this.now.style.transform = `translateX(${this.plot.valToPos(state.time, 'x')}px)`; }
}

// --- time

function seek(t) {
  state.time = Math.min(end, Math.max(start, Number(t)));
  state.dirty = true;
}

function play(on) {
  state.playing = on;
  state.dirty = true;
  element('play').innerHTML = on ? '&#10073;&#10073;' : '&#9654;';
  element('play').setAttribute('aria-label', on ? 'Pause' : 'Play');
  if (on && state.time >= end) seek(start);
}

let before = 0, second = { at: 0, frames: 0 };
function frame(now) {
  if (state.playing) {
    const next = state.time + state.speed * Math.min(0.1, (now - before) / 1000);
    if (next >= end && !repeat.checked) { seek(end); play(false); } else seek(next >= end ? start : next);
  }
  before = now;
  controls.update();
  if (state.dirty) { draw(); state.frames += 1; }
  if (now - second.at >= 1000) {
    state.rate = 1000 * (state.frames - second.frames) / (now - second.at);
    second = { at: now, frames: state.frames };
  }
  requestAnimationFrame(frame);
}

// --- controls and legend

function choice(name, text, on, act) {
  const label = make('label', element('shown').querySelector('div'));
  const box = make('input', label, { type: 'checkbox', name, checked: on, onchange: () => { act(box.checked); state.dirty = true; } });
  label.append(text);
  act(on);
  return box;
}

function controlsAndLegend() {
  const show = (part) => (on) => machines.forEach((m) => {
    for (const object of [m.parts[part]].flat()) object.visible = on;
  });
  const any = (test) => content.runs.some(test);
  if (any((run) => run.rotors)) choice('thrust', 'thrust', true, show('thrust'));
  if (any((run) => run.reactions)) choice('reactions', 'reaction forces', false, show('reactions'));
  if (machines.some((m) => m.parts.sun.length)) choice('sun', 'sun ray and panel normal', true, show('sun'));
  choice('joints', 'joints', true, show('joints'));
  choice('trails', 'trails', true, show('trails'));
  choice('names', 'names of bodies', false, (on) => { named.bodies = on; });
  if (any((run) => run.joints.length)) choice('jointnames', 'names of joints', false, (on) => { named.joints = on; });
  choice('grid', 'ground grid', true, (on) => floorOf.forEach(({ grid }) => { grid.visible = on; }));
  choice('follow', 'follow the machine', travelling, (on) => { state.follow = on; });
  for (const x of [0.05, 0.1, 0.25, 0.5, 1, 2, 4]) make('option', element('speed'), { value: x, textContent: `${x} \u00d7` });
  element('speed').value = 1;
  element('speed').onchange = () => { state.speed = Number(element('speed').value); };
  for (const name of Object.keys(VIEWS)) make('option', element('camera'), { textContent: name });
  element('camera').onchange = () => look(element('camera').value);
  element('play').onclick = () => play(!state.playing);
  Object.assign(element('scrub'), { min: start, max: end });
  element('scrub').oninput = () => { play(false); seek(element('scrub').value); };
  document.addEventListener('keydown', (event) => {
    if (event.target.matches('input:not([type=range]), select, button, summary')) return;
    if (event.key === ' ') { play(!state.playing); event.preventDefault(); }
  });
  legend();
}

function legend() {
  content.runs.forEach((run, k) => {
    const title = make('div', element('titles'), { textContent: content.runs.length > 1 ? `${'AB'[k]}: ${run.title}` : run.title });
    if (run.note) make('small', title, { textContent: run.note });
  });
  const chip = (colour, text) => {
    const line = make('span', element('legend'));
    make('i', line).style.background = colour;
    line.append(text);
  };
  new Map(machines.flatMap((m) => [...m.colours])).forEach((colour, name) => chip(colour, words(name)));
  machines.forEach((m, k) => {
    const of = machines.length > 1 ? ` (${'AB'[k]})` : '';
    if (m.largestThrust) chip(COLOURS.thrust, `thrust${of}: 0.1 m is ${short(0.1 / m.thrustScale)} N`);
    if (m.typicalReaction) chip(COLOURS.reaction, `reaction force${of}: 0.1 m is ${short(0.4 * m.typicalReaction / m.size)} N`);
  });
  if (machines.some((m) => m.run.reference)) chip(COLOURS.reference, 'reference path');
  if (machines.some((m) => m.run.sun)) chip(COLOURS.sun, 'sun ray');
  if (machines.some((m) => m.parts.sun.length)) chip(COLOURS.normal, 'panel normal');
  make('p', element('legend'), { textContent: `Grid of ${[...new Set(floorOf.map((f) => short(f.step)))].join(' and ')} m. `
    + (machines.some((m) => m.run.rotors) ? `Rotors turn ${ROTOR_SLOWNESS} times slower than in the run. ` : '')
    + 'Drag to turn, wheel to zoom, right button to move; click a plot to go to that time.' });
}

const plots = [];
controlsAndLegend();
const repeat = choice('repeat', 'repeat at the end', true, () => {});
const [upper, lower] = document.querySelectorAll('.plot');
plots.push(new Plot(upper, () => 0));
plots.push(new Plot(lower, (titles) => Math.max(0, titles.findIndex((t) => /reaction|thrust|energy/.test(t)))));
resize();
paintGround();
look('three-quarter');
new ResizeObserver(resize).observe(element('scene'));
window.matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => {
  paintGround();
  plots.forEach((plot) => plot.plot.redraw());
});

// Address such as page.html#t=0.5&view=top&show=reactions,names&play=1.
const address = new URLSearchParams(location.hash.slice(1));
for (const name of (address.get('show') || '').split(',').filter(Boolean)) {
  const box = element('shown').querySelector(`[name=${CSS.escape(name)}]`);
  if (box && !box.checked) box.click();
}
if (VIEWS[address.get('view')]) { element('camera').value = address.get('view'); look(address.get('view')); }
if (address.has('t')) seek(address.get('t'));
if (address.has('play')) play(true);
requestAnimationFrame(frame);

// For tests and for those who embed the page: poses as they are drawn, in the run's own axes.
window.viewer = Object.freeze({
  start, end, titles: content.runs.map((run) => run.title), seek,
  get time() { return state.time; },
  get playing() { return state.playing; },
  get frames() { return state.frames; },
  get framesPerSecond() { return state.rate; },
  play: () => play(true),
  pause: () => play(false),
  pose(name, run = 0) {
    const { position, quaternion: q } = machines[run].bodies.get(name);
    return { position: position.toArray(), orientation: [q.w, q.x, q.y, q.z] };
  },
});
