'use strict';
// Numbers of a run over time: decoding, and values between the saved times.

function decoded(text, Kind) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let k = 0; k < raw.length; k++) bytes[k] = raw.charCodeAt(k);
  return new Kind(bytes.buffer);
}

class Motion {
  constructor(run) {
    this.times = decoded(run.times, Float64Array);
    this.positions = decoded(run.positions, Float32Array);
    this.orientations = decoded(run.orientations, Float32Array);
    this.bodies = run.bodies.length;
    this.start = this.times[0];
    this.end = this.times[this.times.length - 1];
    this.from = new library.Quaternion();
    this.to = new library.Quaternion();
  }

  // Saved time before t, and the share of the way to the next one.
  locate(t) {
    const times = this.times;
    let low = 0, high = times.length - 1;
    if (t >= times[high]) return [high, 0];
    if (t <= times[0]) return [0, 0];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= t) low = middle; else high = middle;
    }
    return [low, (t - times[low]) / (times[high] - times[low])];
  }

  // Row `index` of vectors (times, count, 3) at t, linear between saved times.
  vector(values, count, index, [k, share], out) {
    const a = 3 * (k * count + index), b = share ? a + 3 * count : a;
    const mix = (c) => (share ? values[a + c] + share * (values[b + c] - values[a + c]) : values[a + c]);
    return out.set(mix(0), mix(1), mix(2));
  }

  // Pose of a body at t: linear in position, the shortest rotation in orientation.
  pose(body, at, object) {
    const [k, share] = at;
    this.vector(this.positions, this.bodies, body, at, object.position);
    this.quaternion(k, body, this.from);
    if (!share) { object.quaternion.copy(this.from); return; }
    this.quaternion(k + 1, body, this.to);
    object.quaternion.slerpQuaternions(this.from, this.to, share);
  }

  // Euler parameters are in the order e0 to e3, quaternions of three.js end with e0.
  quaternion(k, body, out) {
    const e = this.orientations, a = 4 * (k * this.bodies + body);
    out.set(e[a + 1], e[a + 2], e[a + 3], e[a]);
  }
}
