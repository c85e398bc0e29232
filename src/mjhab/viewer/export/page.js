// Draws the episode that lies in this page: WebGL 2 for the home, 2-D canvases for the time line and the curves.
"use strict";
const $ = (id) => document.getElementById(id);
const TYPES = { uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array };
const TOP = 65535, MAX_LAMPS = 8, NOW_COLOR = "#c026d3";

async function unpack(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const all = await new Response(stream).arrayBuffer();
  const size = new DataView(all).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(all, 4, size)));
  const start = 4 + Math.ceil(size / 4) * 4;
  const array = (place) => new TYPES[place.type](all, start + place.at, place.n);
  return { head, array };
}

// -- small linear algebra: matrices are columns, as WebGL takes them ---------------------------------------------
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((x) => x / n); };
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
function perspective(fovy, aspect, near, far) {
  const f = 1 / Math.tan(fovy / 2);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0];
}
function lookAt(eye, target) {
  const z = unit(sub(eye, target)), x = unit(cross([0, 0, 1], z)), y = cross(z, x);
  return [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1];
}
function times(a, b) {
  const out = new Array(16).fill(0);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}
function placed(p, q) {
  const [w, x, y, z] = q;
  return [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
    2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
    2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0, p[0], p[1], p[2], 1];
}

// -- poses ---------------------------------------------------------------------------------------------------------
function readPoses(pose, array, frames) {
  const change = array(pose), count = pose.bodies.length * 7, whole = new Uint16Array(frames * count);
  for (let c = 0; c < count; c++) {
    let value = 0;
    for (let t = 0; t < frames; t++) { value = (value + change[c * frames + t]) & TOP; whole[t * count + c] = value; }
  }
  const at = (t, body) => {
    const k = t * count + body * 7;
    const p = [0, 1, 2].map((i) => pose.low[i] + whole[k + i] / TOP * pose.span);
    const q = [3, 4, 5, 6].map((i) => whole[k + i] / TOP * 2 - 1);
    return [p, q];
  };
  return (time, body) => {
    const t = Math.min(Math.floor(time), frames - 1), n = Math.min(t + 1, frames - 1);
    const [p, q] = at(t, body), [p1, q1] = at(n, body);
    const jump = Math.hypot(...sub(p1, p)) > 0.25, s = jump ? 0 : time - t;
    const sign = q.reduce((sum, x, i) => sum + x * q1[i], 0) < 0 ? -1 : 1;
    return [p.map((x, i) => x + s * (p1[i] - x)), unit(q.map((x, i) => (1 - s) * x + s * sign * q1[i]))];
  };
}

// -- drawing ---------------------------------------------------------------------------------------------------------
const VERTEX = `#version 300 es
in vec3 place; in vec3 normal; in vec2 uv;
uniform mat4 model, view; uniform vec3 low, span; uniform vec2 uvLow, uvSpan;
out vec3 at, facing; out vec2 on;
void main() {
  vec4 world = model * vec4(low + place * span, 1.0);
  at = world.xyz; facing = mat3(model) * normal; on = uvLow + uv * uvSpan;
  gl_Position = view * world;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 at, facing; in vec2 on; out vec4 color;
uniform vec3 tint, eye; uniform float gloss; uniform bool textured; uniform sampler2D picture;
uniform int lamps; uniform vec3 lampPos[${MAX_LAMPS}], lampColor[${MAX_LAMPS}];
void main() {
  vec3 n = normalize(facing), look = normalize(eye - at);
  vec3 base = tint;
  if (textured) base *= pow(texture(picture, on).rgb, vec3(2.2));
  vec3 light = mix(vec3(0.30, 0.28, 0.26), vec3(0.50, 0.51, 0.53), 0.5 + 0.5 * n.z), shine = vec3(0.0);
  for (int k = 0; k < ${MAX_LAMPS}; k++) {
    if (k >= lamps) break;
    vec3 way = lampPos[k] - at; float d2 = dot(way, way); vec3 l = way * inversesqrt(d2);
    vec3 power = lampColor[k] * 1.5 / (1.0 + 0.35 * d2);
    light += power * max(dot(n, l), 0.0);
    shine += power * gloss * pow(max(dot(n, normalize(l + look)), 0.0), 40.0);
  }
  vec3 lit = base * light + 0.3 * shine;
  color = vec4(pow(lit / (1.0 + 0.25 * lit), vec3(1.0 / 2.2)), 1.0);
}`;

function program(gl) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

class Scene {
  constructor(canvas, head, array) {
    const gl = this.gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL 2");
    this.canvas = canvas; this.head = head;
    this.program = program(gl); gl.useProgram(this.program);
    this.where = (name) => gl.getUniformLocation(this.program, name);
    this.names = {};
    for (const name of ["model", "view", "low", "span", "uvLow", "uvSpan", "tint", "eye", "gloss", "textured", "lamps", "lampPos", "lampColor"]) this.names[name] = this.where(name);
    this.looks = head.looks.map((look) => ({ ...look, map: look.texture ? this.texture(look.texture) : null }));
    this.home = this.load(head.home_model, array);
    this.movable = head.movable.flatMap((model) => { const parts = this.load(model, array); return model.bodies.map((body) => ({ body: head.pose.bodies.indexOf(body), parts })); });
    const ball = this.ball(); this.mark = ball;
    this.setLamps();
    gl.enable(gl.DEPTH_TEST); gl.clearColor(0.875, 0.906, 0.933, 1);
  }
  buffer(target, data) { const gl = this.gl, b = gl.createBuffer(); gl.bindBuffer(target, b); gl.bufferData(target, data, gl.STATIC_DRAW); return b; }
  shape(place, normal, uv, faces) {
    const gl = this.gl, vao = gl.createVertexArray();
    gl.bindVertexArray(vao);
    [["place", place, 3], ["normal", normal, 3], ["uv", uv, 2]].forEach(([name, data, size]) => {
      this.buffer(gl.ARRAY_BUFFER, data);
      const at = gl.getAttribLocation(this.program, name), kind = data instanceof Int8Array ? gl.BYTE : gl.UNSIGNED_SHORT;
      if (at < 0) return;
      gl.enableVertexAttribArray(at); gl.vertexAttribPointer(at, size, kind, true, 0, 0);
    });
    this.buffer(gl.ELEMENT_ARRAY_BUFFER, faces);
    gl.bindVertexArray(null);
    return { vao, count: faces.length, kind: faces instanceof Uint32Array ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT };
  }
  load(model, array) {
    return model.parts.map((part) => ({
      ...this.shape(array(part.vertices), array(part.normals), array(part.uv), array(part.faces)),
      look: this.looks[part.look], low: part.vertices.low, span: part.vertices.span, uvLow: part.uv.low, uvSpan: part.uv.span,
    }));
  }
  ball() {
    const corners = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]];
    const place = new Uint16Array(corners.flat().map((x) => (x + 1) / 2 * TOP)), normal = new Int8Array(corners.flat().map((x) => 127 * x));
    const faces = new Uint16Array([0, 2, 4, 2, 1, 4, 1, 3, 4, 3, 0, 4, 2, 0, 5, 1, 2, 5, 3, 1, 5, 0, 3, 5]);
    return { ...this.shape(place, normal, new Uint16Array(12), faces), low: [-1, -1, -1], span: [2, 2, 2], uvLow: [0, 0], uvSpan: [1, 1] };
  }
  texture(url) {
    const gl = this.gl, made = gl.createTexture(), image = new Image();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array([200, 200, 200, 255]));
    image.onload = () => {
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
      gl.generateMipmap(gl.TEXTURE_2D);
      const fine = gl.getExtension("EXT_texture_filter_anisotropic");
      if (fine) gl.texParameterf(gl.TEXTURE_2D, fine.TEXTURE_MAX_ANISOTROPY_EXT, 8);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
      this.changed = true;
    };
    image.src = url;
    return made;
  }
  setLamps() {
    const gl = this.gl, lamps = this.head.lamps.slice(0, MAX_LAMPS);
    gl.uniform1i(this.names.lamps, lamps.length);
    if (!lamps.length) return;
    gl.uniform3fv(this.names.lampPos, lamps.flatMap((lamp) => lamp.pos));
    gl.uniform3fv(this.names.lampColor, lamps.flatMap((lamp) => lamp.color));
  }
  draw(poses, time, eye, target, marks) {
    const gl = this.gl, c = this.canvas, ratio = Math.min(devicePixelRatio, 2);
    const width = Math.round(c.clientWidth * ratio), height = Math.round(c.clientHeight * ratio);
    if (c.width !== width || c.height !== height) { c.width = width; c.height = height; }
    gl.viewport(0, 0, width, height); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.names.view, false, times(perspective(0.9, width / Math.max(height, 1), 0.05, 80), lookAt(eye, target)));
    gl.uniform3fv(this.names.eye, eye);
    this.parts(this.home, placed([0, 0, 0], [1, 0, 0, 0]));
    for (const { body, parts } of this.movable) {
      const [p, q] = poses(time, body);
      if (p[2] > -5) this.parts(parts, placed(p, q));
    }
    for (const [p, radius, tint] of marks) {
      const model = placed(p, [1, 0, 0, 0]); [0, 5, 10].forEach((k) => { model[k] = radius; });
      this.parts([{ ...this.mark, look: { color: tint, gloss: 0, map: null } }], model);
    }
  }
  parts(parts, model) {
    const gl = this.gl, n = this.names;
    gl.uniformMatrix4fv(n.model, false, model);
    for (const part of parts) {
      gl.uniform3fv(n.low, part.low); gl.uniform3fv(n.span, part.span);
      gl.uniform2fv(n.uvLow, part.uvLow); gl.uniform2fv(n.uvSpan, part.uvSpan);
      gl.uniform3fv(n.tint, part.look.color); gl.uniform1f(n.gloss, part.look.gloss);
      gl.uniform1i(n.textured, part.look.map ? 1 : 0);
      if (part.look.map) gl.bindTexture(gl.TEXTURE_2D, part.look.map);
      gl.bindVertexArray(part.vao); gl.drawElements(gl.TRIANGLES, part.count, part.kind, 0);
    }
  }
}

// -- the view: drag turns, shift or right drag moves, wheel and two fingers zoom --------------------------------
class Orbit {
  constructor(canvas, eye, target) {
    const away = eye.map((x, i) => x - target[i]);
    this.target = target; this.far = Math.hypot(...away); this.changed = true;
    this.yaw = Math.atan2(away[1], away[0]); this.pitch = Math.asin(away[2] / this.far);
    const held = new Map();
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); held.set(e.pointerId, [e.clientX, e.clientY]); });
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (e) => held.delete(e.pointerId));
    canvas.addEventListener("pointermove", (e) => {
      const before = held.get(e.pointerId);
      if (!before) return;
      const dx = e.clientX - before[0], dy = e.clientY - before[1];
      if (held.size === 2) {
        const other = [...held].find(([id]) => id !== e.pointerId)[1];
        const was = Math.hypot(before[0] - other[0], before[1] - other[1]), is = Math.hypot(e.clientX - other[0], e.clientY - other[1]);
        this.zoom(was / Math.max(is, 1));
      } else if (e.shiftKey || e.buttons === 2) this.pan(dx, dy);
      else { this.yaw -= dx * 0.006; this.pitch = Math.min(1.5, Math.max(-0.2, this.pitch + dy * 0.006)); }
      held.set(e.pointerId, [e.clientX, e.clientY]); this.changed = true;
    });
    canvas.addEventListener("wheel", (e) => { e.preventDefault(); this.zoom(Math.exp(e.deltaY * 0.001)); }, { passive: false });
  }
  zoom(factor) { this.far = Math.min(25, Math.max(0.3, this.far * factor)); this.changed = true; }
  pan(dx, dy) {
    const s = this.far * 0.0015, c = Math.cos(this.yaw), n = Math.sin(this.yaw);
    this.target = [this.target[0] + s * (dx * n + dy * -c), this.target[1] + s * (-dx * c + dy * -n), this.target[2]];
  }
  get eye() {
    const c = Math.cos(this.pitch);
    return [this.target[0] + this.far * c * Math.cos(this.yaw), this.target[1] + this.far * c * Math.sin(this.yaw), this.target[2] + this.far * Math.sin(this.pitch)];
  }
}

// -- 2-D pictures -------------------------------------------------------------------------------------------------
function brush(canvas) {
  const ratio = Math.min(devicePixelRatio, 2), w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio)) { canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio); }
  const g = canvas.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0); g.clearRect(0, 0, w, h); g.font = "11px system-ui";
  return [g, w, h, getComputedStyle(document.body).color];
}
function curve(canvas, name, lines, now) {
  const [g, w, h, ink] = brush(canvas), n = lines[0].values.length;
  let low = 0, high = 1e-9;
  for (const { values } of lines) for (const v of values) { if (v < low) low = v; if (v > high) high = v; }
  const x = (t) => t / Math.max(n - 1, 1) * w, y = (v) => h - 2 - (v - low) / (high - low) * (h - 16);
  for (const { values, color } of lines) {
    g.beginPath(); g.strokeStyle = color; g.lineWidth = 1.4;
    values.forEach((v, t) => (t ? g.lineTo(x(t), y(v)) : g.moveTo(x(t), y(v))));
    g.stroke();
  }
  g.strokeStyle = NOW_COLOR; g.beginPath(); g.moveTo(x(now), 12); g.lineTo(x(now), h); g.stroke();
  const at = lines.map(({ values }) => values[Math.floor(now)].toLocaleString(undefined, { maximumFractionDigits: 2 })).join(" / ");
  g.fillStyle = ink; g.fillText(`${name}: ${at}`, 2, 10);
}
function timeLine(canvas, head, actor, now) {
  const [g, w, h] = brush(canvas), n = Math.max(head.frames - 1, 1), x = (t) => t / n * w;
  for (const [index, start, end] of head.spans) {
    g.fillStyle = head.plan[index].color; g.fillRect(x(start), 18, Math.max(x(end + 1) - x(start), 1), 24);
    g.save(); g.beginPath(); g.rect(x(start), 18, x(end + 1) - x(start), 24); g.clip();
    g.fillStyle = "white"; g.fillText(head.plan[index].name, x(start) + 5, 34); g.restore();
  }
  actor.forEach((a, t) => { g.fillStyle = head.actors[a].color; g.fillRect(x(t), 44, x(1) + 0.5, 6); });
  for (const event of head.events) {
    const at = x(event.step);
    g.fillStyle = event.color; g.beginPath(); g.moveTo(at, 17); g.lineTo(at - 5, 6); g.lineTo(at + 5, 6); g.fill();
  }
  g.fillStyle = NOW_COLOR; g.fillRect(x(now) - 1, 2, 2, h - 4);
}

// -- the page -----------------------------------------------------------------------------------------------------
async function main() {
  const { head, array } = await unpack($("data").textContent);
  const poses = readPoses(head.pose, array, head.frames), last = head.frames - 1;
  const series = Object.fromEntries(Object.entries(head.series).map(([name, place]) => [name, array(place)]));
  const checks = array(head.check), terms = array(head.term), actor = array(head.actor);
  const points = array(head.pose.contacts), counts = array(head.pose.contact_counts), starts = [0];
  counts.forEach((count) => starts.push(starts[starts.length - 1] + count));
  const scene = new Scene($("scene"), head, array);
  const [base] = poses(0, head.pose.base);
  const orbit = new Orbit($("scene"), head.pose.eye, head.pose.target);
  const pictures = head.pictures ? Object.entries(head.pictures.cameras).map(([name, place]) => {
    const bytes = array(place); let at = 0;
    const urls = place.sizes.map((size) => { at += size; return URL.createObjectURL(new Blob([bytes.slice(at - size, at)], { type: "image/jpeg" })); });
    const figure = document.createElement("figure"), image = document.createElement("img"), caption = document.createElement("figcaption");
    caption.textContent = name.replace("fetch_", "") + " camera"; image.alt = caption.textContent;
    figure.append(image, caption); $("cameras").append(figure);
    return { urls, image };
  }) : [];
  $("over").textContent = head.over ? `Ended: ${head.over}` : "";
  $("instruction").textContent = head.instruction ? `“${head.instruction}”` : "";
  $("home").textContent = `home ${head.home}`;
  head.actors.forEach(({ name, color }) => { const item = document.createElement("span"), mark = document.createElement("i"); mark.style.background = color; item.append(mark, name); $("actors").append(item); });
  head.plan.forEach((entry) => { const item = document.createElement("li"); item.style.borderColor = entry.color; $("plan").append(item); });
  head.checks.forEach((name) => { const item = document.createElement("span"); item.className = "check"; item.textContent = name.replaceAll("_", " "); $("checks").append(item); });
  head.terms.forEach((name) => { const row = document.createElement("div"); row.className = "term"; row.innerHTML = "<span></span><span><i></i></span><b></b>"; row.firstChild.textContent = name; $("terms").append(row); });
  const state = { now: 0, playing: false, shown: -1, size: "" };
  let followed = base;

  function fill(step) {
    const active = series.active[step];
    head.plan.forEach((entry, k) => {
      const item = $("plan").children[k];
      item.className = k < active ? "done" : k === active ? "active" : "";
      item.title = entry.instruction;
      item.textContent = `${k < active ? "✓" : k === active ? "▶" : "·"} ${entry.name}${k <= active && entry.ended ? ` (${entry.ended.replaceAll("_", " ")})` : ""}`;
    });
    [...$("actors").children].forEach((item, k) => item.classList.toggle("acts", step > 0 && actor[step - 1] === k));
    [...$("checks").children].forEach((item, k) => item.classList.toggle("on", !!checks[step * head.checks.length + k]));
    const row = head.terms.map((_, k) => terms[step * head.terms.length + k]), most = Math.max(1e-9, ...row.map(Math.abs));
    const judged = head.plan[series.active[Math.max(step - 1, 0)]], own = judged ? judged.terms.filter((name) => head.terms.includes(name)) : [];
    [...$("terms").children].forEach((item, k) => {
      item.hidden = own.length > 0 && !own.includes(head.terms[k]);
      const bar = item.querySelector("i"), share = 50 * Math.abs(row[k]) / most;
      bar.style.cssText = `left:${row[k] < 0 ? 50 - share : 50}%;width:${share}%;background:${row[k] < 0 ? "#dc2626" : "#16a34a"}`;
      item.lastChild.textContent = row[k].toFixed(3);
    });
    if (pictures.length) {
      const states = head.pictures.states; let k = 0;
      while (k + 1 < states.length && states[k + 1] <= step) k++;
      pictures.forEach(({ urls, image }) => { if (image.src !== urls[k]) image.src = urls[k]; });
    }
    const near = head.events.filter((event) => event.step <= step).slice(-1)[0];
    $("now").textContent = `${(step * head.step).toFixed(2)} s · step ${step}${near ? ` · ${near.name.replaceAll("_", " ")}` : ""}`;
    $("line").setAttribute("aria-valuenow", step);
  }
  function curves() {
    timeLine($("line"), head, actor, state.now);
    curve($("force"), "robot force [N]", [{ values: series.force, color: "#3b82f6" }], state.now);
    const limit = series.limit.some((x) => x > 0) ? [{ values: series.limit, color: "#dc2626" }] : [];
    curve($("sum"), "cumulative [N × steps] / limit", [{ values: series.sum, color: "#3b82f6" }, ...limit], state.now);
    curve($("reward"), "reward", [{ values: series.reward, color: "#16a34a" }], state.now);
  }
  function marks(step) {
    const found = [];
    for (let k = starts[step]; k < starts[step + 1]; k++) found.push([[points[3 * k], points[3 * k + 1], points[3 * k + 2]], 0.012, [0.8, 0.05, 0.03]]);
    if (checks[step * head.checks.length + head.checks.indexOf("is_grasped")]) found.push([poses(state.now, head.pose.hand)[0], 0.02, [0.05, 0.6, 0.1]]);
    return found;
  }
  function frame(seconds) {
    if (state.playing) {
      state.now = Math.min(last, state.now + seconds / head.step * +$("speed").value);
      if (state.now >= last) play(false);
    }
    const step = Math.floor(state.now), size = `${innerWidth} ${innerHeight}`;
    if (state.now !== state.shown || size !== state.size) { fill(step); curves(); scene.changed = true; }
    const here = poses(state.now, head.pose.base)[0];
    if ($("follow").checked) { orbit.target = orbit.target.map((x, i) => x + here[i] - followed[i]); }
    followed = here; state.shown = state.now; state.size = size;
    if (scene.changed || orbit.changed) { scene.draw(poses, state.now, orbit.eye, orbit.target, marks(step)); scene.changed = orbit.changed = false; }
  }
  const play = (on) => { if (on) $("still").hidden = true; if (on && state.now >= last) state.now = 0; state.playing = on; $("play").textContent = on ? "Pause" : "Play"; };
  const scrub = (step) => { play(false); $("still").hidden = true; state.now = Math.min(last, Math.max(0, step)); };
  $("stills").hidden = !head.stills.length;
  head.stills.forEach(({ step, picture }) => {
    const item = document.createElement("button"), image = document.createElement("img");
    item.type = "button"; image.src = picture; image.alt = `step ${step}`;
    item.append(image, image.alt);
    item.onclick = () => { scrub(step); $("still").firstChild.src = picture; $("still").hidden = false; };
    $("stills").append(item);
  });
  $("still").onclick = () => { $("still").hidden = true; };
  $("play").onclick = () => play(!state.playing);
  const line = $("line");
  const to = (e) => { const box = line.getBoundingClientRect(); scrub(Math.round((e.clientX - box.left) / box.width * last)); };
  line.setAttribute("aria-valuemax", last); line.setAttribute("aria-valuemin", 0);
  line.addEventListener("pointerdown", (e) => { line.setPointerCapture(e.pointerId); to(e); });
  line.addEventListener("pointermove", (e) => { if (e.buttons) to(e); });
  addEventListener("keydown", (e) => {
    if (e.target.tagName === "SELECT") return;
    if (e.code === "Space" && e.target.tagName !== "BUTTON") { play(!state.playing); e.preventDefault(); }
    if (e.code === "ArrowRight") scrub(Math.floor(state.now) + 1);
    if (e.code === "ArrowLeft") scrub(Math.ceil(state.now) - 1);
  });
  let before = performance.now();
  const loop = (now) => { frame((now - before) / 1000); before = now; requestAnimationFrame(loop); };
  requestAnimationFrame(loop);
  // For scripts that look at the page.
  window.episode = { scrub, state, frames: head.frames, robot: () => poses(state.now, head.pose.hand)[0] };
}
main().catch((error) => {
  const told = document.createElement("div");
  told.className = "problem"; told.textContent = `This episode cannot be shown: ${error.message}`;
  document.body.append(told);
});
