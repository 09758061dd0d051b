'use strict';
// The mechanism of one run as objects of three.js, at any time of the run.

const L = library;
const PALETTE = ['#0072b2', '#e69f00', '#009e73', '#d55e00', '#56b4e9', '#cc79a7', '#f0e442'];
const COLOURS = { base: '#8b929c', panel: '#1d3f72', cells: '#8fb4e8', joint: '#69717d', ground: '#7a7f87',
  thrust: '#009e73', reaction: '#d55e00', sun: '#e8b100', normal: '#56b4e9', rotor: '#5b626c', reference: '#cc79a7' };
// Rotors are drawn turning so many times slower, as the eye and the screen could not follow.
const ROTOR_SLOWNESS = 40;
const UP = new L.Vector3(0, 0, 1);

function solid(geometry, colour, more = {}) {
  return new L.Mesh(geometry, new L.MeshLambertMaterial({ color: colour, ...more }));
}

// Cylinder along z.
function cylinder(radius, length, sides = 28) {
  return new L.CylinderGeometry(radius, radius, length, sides).rotateX(Math.PI / 2);
}

function turned(e) { return new L.Quaternion(e[1], e[2], e[3], e[0]); }

function column(frame, k) { return new L.Vector3(frame[0][k], frame[1][k], frame[2][k]); }

// Arrow of variable length that starts at its origin.
class Arrow extends L.Group {
  constructor(colour, width) {
    super();
    const material = new L.MeshBasicMaterial({ color: colour });
    this.shaft = new L.Mesh(cylinder(width, 1, 8).translate(0, 0, 0.5), material);
    this.head = new L.Mesh(new L.ConeGeometry(3 * width, 8 * width, 12).rotateX(Math.PI / 2), material);
    this.width = width;
    this.add(this.shaft, this.head);
  }

  // Vector in the axes of the parent; an arrow shorter than its width is not drawn.
  along(vector) {
    const length = vector.length();
    this.visible = length > this.width;
    if (!this.visible) return;
    const head = Math.min(8 * this.width, 0.5 * length);
    this.quaternion.setFromUnitVectors(UP, vector.clone().divideScalar(length));
    this.shaft.scale.z = length - head;
    this.head.scale.setScalar(head / (8 * this.width));
    this.head.position.z = length - 0.5 * head;
  }
}

class Machine {
  constructor(run) {
    this.run = run;
    this.motion = new Motion(run);
    this.root = new L.Group();
    this.size = run.size;
    this.parts = { trails: new L.Group(), thrust: new L.Group(), reactions: new L.Group(), joints: [], sun: [] };
    this.root.add(this.parts.trails, this.parts.thrust, this.parts.reactions);
    this.bodies = new Map();
    this.colours = new Map();
    this.moving = [];
    run.bodies.forEach((body, k) => this.addBody(body, k));
    run.joints.forEach((joint) => this.addJoint(joint));
    if (run.rotors) this.addRotors(run.rotors);
    if (run.reactions) this.addReactions(run);
    this.addDirections(run);
    this.addTrails(run);
    this.update(this.motion.start);
  }

  group(name) { return this.bodies.get(name) || this.root; }

  index(name) { return this.run.bodies.findIndex((body) => body.name === name); }

  addBody(body, k) {
    const group = new L.Group();
    const rotors = this.run.rotors && this.run.rotors.bodies.includes(body.name);
    const panel = body.shapes.some((shape) => shape.kind === 'panel');
    const others = [...this.colours.values()].filter((colour) => PALETTE.includes(colour)).length;
    const colour = rotors ? COLOURS.base : panel ? COLOURS.panel : PALETTE[others % PALETTE.length];
    this.colours.set(body.name, colour);
    for (const shape of body.shapes) {
      const [a, b, c] = shape.size;
      const geometry = shape.kind === 'sphere' ? new L.SphereGeometry(a, 28, 18)
        : shape.kind === 'cylinder' ? cylinder(a, b) : new L.BoxGeometry(a, b, c);
      const mesh = solid(geometry, colour);
      mesh.position.set(...shape.position);
      mesh.quaternion.copy(turned(shape.orientation));
      if (shape.kind === 'box' || shape.kind === 'panel') {
        mesh.add(new L.LineSegments(new L.EdgesGeometry(geometry),
          new L.LineBasicMaterial({ color: '#000', transparent: true, opacity: 0.35 })));
      }
      if (shape.kind === 'panel') mesh.add(cells(a, b, c));
      group.add(mesh);
    }
    this.bodies.set(body.name, group);
    this.root.add(group);
    this.moving.push((at) => this.motion.pose(k, at, group));
  }

  addJoint(joint) {
    const radius = 0.008 * this.size, length = 4.5 * radius;
    const put = (side, geometry, z) => {
      const mesh = solid(geometry, COLOURS.joint);
      mesh.position.set(...joint[`point_${side}`]);
      if (z) mesh.quaternion.setFromUnitVectors(UP, z);
      this.group(joint[`body_${side}`]).add(mesh);
      this.parts.joints.push(mesh);
      return mesh;
    };
    const kind = joint.kind;
    if (kind === 'revolute') put('j', cylinder(radius, length), column(joint.frame_j, 2));
    else if (kind === 'universal') {
      put('i', cylinder(0.8 * radius, length), column(joint.frame_i, 0));
      put('j', cylinder(0.8 * radius, length), column(joint.frame_j, 1));
    } else if (kind === 'weld') put('j', new L.BoxGeometry(2 * radius, 2 * radius, 2 * radius));
    else if (joint.slide) {
      const [low, high] = joint.slide, axis = column(joint.frame_i, 2);
      const rail = put('i', cylinder(0.4 * radius, high - low + 2 * length), axis);
      rail.material.color.set(COLOURS.ground);
      rail.position.addScaledVector(axis, 0.5 * (low + high));
    } else put('j', new L.SphereGeometry(1.25 * radius, 16, 12));
    if (kind === 'distance' || kind === 'revolute_spherical') this.addLink(joint, 0.6 * radius);
    for (const side of ['i', 'j']) {
      if (joint[`body_${side}`] !== 'ground') continue;
      const plate = put(side, new L.BoxGeometry(5 * radius, 5 * radius, 0.8 * radius));
      plate.material.color.set(COLOURS.ground);
      plate.position.z -= 1.6 * radius;
    }
  }

  // A massless rod between the points of a joint that keeps their distance.
  addLink(joint, radius) {
    const rod = solid(cylinder(radius, 1, 12), COLOURS.joint);
    const [a, b] = [new L.Vector3(), new L.Vector3()];
    this.root.add(rod);
    this.moving.push(() => {
      this.point(joint, 'i', a);
      this.point(joint, 'j', b);
      rod.position.addVectors(a, b).multiplyScalar(0.5);
      b.sub(a);
      rod.scale.z = b.length();
      rod.quaternion.setFromUnitVectors(UP, b.normalize());
    });
  }

  // World point of a joint on one of its bodies.
  point(joint, side, out) {
    out.set(...joint[`point_${side}`]);
    const body = this.bodies.get(joint[`body_${side}`]);
    return body ? out.applyQuaternion(body.quaternion).add(body.position) : out;
  }

  addRotors(rotors) {
    const { motion } = this, count = rotors.spin.length;
    const speed = decoded(rotors.speed, Float32Array), thrust = decoded(rotors.thrust, Float32Array);
    const places = rotors.positions.map((p) => new L.Vector3(...p));
    const gaps = places.flatMap((p, k) => places.slice(k + 1).map((q) => p.distanceTo(q)));
    const radius = gaps.length ? 0.45 * Math.min(...gaps) : 0.2 * this.size;
    const largest = thrust.reduce((most, x) => Math.max(most, Math.abs(x)), 0);
    this.thrustScale = largest ? 0.22 * this.size / largest : 0;
    this.largestThrust = largest;
    places.forEach((place, r) => {
      const angles = new Float64Array(motion.times.length);
      for (let k = 1; k < angles.length; k++) {
        angles[k] = angles[k - 1] + 0.5 * (motion.times[k] - motion.times[k - 1])
          * (speed[k * count + r] + speed[(k - 1) * count + r]);
      }
      const blades = new L.Group(), body = this.group(rotors.bodies[r]);
      const disc = solid(cylinder(radius, 0.004 * radius, 36), COLOURS.rotor,
        { transparent: true, opacity: 0.16, depthWrite: false });
      const blade = solid(new L.BoxGeometry(2 * radius, 0.12 * radius, 0.02 * radius), COLOURS.rotor);
      blades.add(disc, blade);
      blades.position.copy(place);
      body.add(blades);
      const arrow = new Arrow(COLOURS.thrust, 0.0045 * this.size);
      this.parts.thrust.add(arrow);
      const push = new L.Vector3();
      this.moving.push(([k, share]) => {
        const next = share ? k + 1 : k;
        const mix = (values, stride, at) => values[k * stride + at]
          + share * (values[next * stride + at] - values[k * stride + at]);
        blades.rotation.z = rotors.spin[r] * mix(angles, 1, 0) / ROTOR_SLOWNESS;
        arrow.position.copy(place).applyQuaternion(body.quaternion).add(body.position);
        push.copy(UP).applyQuaternion(body.quaternion);
        arrow.along(push.multiplyScalar(this.thrustScale * mix(thrust, count, r)));
      });
    });
  }

  addReactions(run) {
    const force = decoded(run.reactions, Float32Array), count = run.joints.length;
    const sizes = [];
    for (let a = 0; a < force.length; a += 3) sizes.push(Math.hypot(force[a], force[a + 1], force[a + 2]));
    sizes.sort((a, b) => a - b);
    // nine of ten arrows are at most so long; loads have spikes
    const typical = sizes[Math.floor(0.9 * (sizes.length - 1))] || 0;
    this.typicalReaction = typical;
    const scale = typical ? 0.25 * this.size / typical : 0;
    run.joints.forEach((joint, r) => {
      const arrow = new Arrow(COLOURS.reaction, 0.0045 * this.size), vector = new L.Vector3();
      this.parts.reactions.add(arrow);
      this.moving.push((at) => {
        this.point(joint, 'j', arrow.position);
        arrow.along(this.motion.vector(force, count, r, at, vector).multiplyScalar(scale));
      });
    });
  }

  // Normals of panels, and the ray from the sun to them.
  addDirections(run) {
    const panels = run.bodies.filter((body) => body.shapes.some((shape) => shape.kind === 'panel'));
    for (const body of panels) {
      const shape = body.shapes.find((each) => each.kind === 'panel');
      const normal = new Arrow(COLOURS.normal, 0.0045 * this.size);
      const up = new L.Vector3(0, 0, 1).applyQuaternion(turned(shape.orientation));
      normal.position.set(...shape.position);
      normal.along(up.multiplyScalar(0.3 * this.size));
      this.group(body.name).add(normal);
      this.parts.sun.push(normal);
    }
    if (!run.sun) return;
    const towards = new L.Vector3(...run.sun), lit = panels.length ? panels : [{ name: run.watch[0] }];
    for (const body of lit) {
      const ray = new Arrow(COLOURS.sun, 0.0045 * this.size);
      ray.along(towards.clone().multiplyScalar(-0.6 * this.size));
      this.root.add(ray);
      this.parts.sun.push(ray);
      const group = this.bodies.get(body.name);
      this.moving.push(() => ray.position.copy(group.position).addScaledVector(towards, 0.65 * this.size));
    }
  }

  // Ways of the watched bodies so far, and the whole way that a closed loop is to follow.
  addTrails(run) {
    const { motion } = this, steps = motion.times.length;
    const add = (points, colour) => {
      const geometry = new L.BufferGeometry().setAttribute('position', new L.Float32BufferAttribute(points, 3));
      const line = new L.Line(geometry, new L.LineBasicMaterial({ color: colour }));
      line.frustumCulled = false;
      this.parts.trails.add(line);
      return geometry;
    };
    for (const name of run.watch) {
      const body = this.index(name), points = new Float32Array(3 * steps);
      for (let k = 0; k < steps; k++) {
        const from = 3 * (k * motion.bodies + body);
        points.set(motion.positions.subarray(from, from + 3), 3 * k);
      }
      const geometry = add(points, this.colours.get(name));
      this.moving.push(([k]) => geometry.setDrawRange(0, k + 1));
    }
    if (run.reference) add(decoded(run.reference, Float32Array), COLOURS.reference);
  }

  update(t) {
    const at = this.motion.locate(t);
    for (const move of this.moving) move(at);
  }

  // Box around the bodies and joints at their present pose; on request without the rotors' bodies.
  bounds(mechanism = false) {
    const box = new L.Box3(), flying = mechanism && this.run.rotors ? this.run.rotors.bodies : [];
    this.root.updateMatrixWorld(true);
    for (const joint of this.parts.joints) box.expandByPoint(joint.getWorldPosition(new L.Vector3()));
    for (const [name, group] of this.bodies) if (!flying.includes(name)) box.expandByObject(group);
    return box.isEmpty() ? this.bounds() : box;
  }

  // Box around the ways of all bodies.
  wayBounds() {
    const box = new L.Box3(), p = this.motion.positions, v = new L.Vector3();
    for (let a = 0; a < p.length; a += 3) box.expandByPoint(v.set(p[a], p[a + 1], p[a + 2]));
    return box.expandByScalar(0.3 * this.size);
  }
}

// Lines between the solar cells on the upper side of a panel.
function cells(a, b, c) {
  const z = 0.5 * c + 0.004 * a, lines = [];
  for (let k = 1; k < 4; k++) {
    const x = a * (k / 4 - 0.5), y = b * (k / 4 - 0.5);
    lines.push(x, -0.5 * b, z, x, 0.5 * b, z, -0.5 * a, y, z, 0.5 * a, y, z);
  }
  const geometry = new L.BufferGeometry().setAttribute('position', new L.Float32BufferAttribute(lines, 3));
  return new L.LineSegments(geometry, new L.LineBasicMaterial({ color: COLOURS.cells }));
}
