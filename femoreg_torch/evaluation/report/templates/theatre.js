"use strict";
(() => {
  const canvas = document.getElementById("theatre"), source = document.getElementById("theatre-data");
  if (!canvas || !source) return;
  const data = JSON.parse(source.textContent), box = canvas.parentElement;
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) {
    box.querySelector(".missing").hidden = false;
    return;
  }

  // vectors and 4 × 4 matrices, column by column as WebGL takes them
  const sub = (a, b) => a.map((v, i) => v - b[i]), dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((v) => v / n); };
  const times = (a, b) => { // a after b
    const c = new Float32Array(16);
    for (let j = 0; j < 4; j++) for (let i = 0; i < 4; i++) for (let k = 0; k < 4; k++) c[4 * j + i] += a[4 * k + i] * b[4 * j + k];
    return c;
  };
  const turn = (axis, angle) => (v) => { // Rodrigues' formula
    const c = Math.cos(angle), s = Math.sin(angle), w = cross(axis, v), d = dot(axis, v) * (1 - c);
    return v.map((x, i) => x * c + w[i] * s + axis[i] * d);
  };

  const program = (vertex, fragment) => {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, "#version 300 es\nprecision highp float;\n" + text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.bindAttribLocation(made, 0, "place");
    gl.bindAttribLocation(made, 1, "extra");
    gl.linkProgram(made);
    return made;
  };
  const solid = program(
    "in vec3 place, extra; uniform mat4 clip; out vec3 normal; void main() { normal = extra; gl_Position = clip * vec4(place, 1.); }",
    "in vec3 normal; uniform vec3 toward; uniform vec4 colour; out vec4 shown; void main() { float light = .35 + .65 * abs(dot(normalize(normal), toward)); shown = vec4(colour.rgb * light, colour.a); }");
  const line = program(
    "in vec3 place; uniform mat4 clip; void main() { gl_Position = clip * vec4(place, 1.); }",
    "uniform vec4 colour; out vec4 shown; void main() { shown = colour; }");
  const screen = program(
    "in vec3 place, extra; uniform mat4 clip; out vec2 at; void main() { at = extra.xy; gl_Position = clip * vec4(place, 1.); }",
    "in vec2 at; uniform sampler2D image; out vec4 shown; void main() { shown = vec4(texture(image, at).rgb * .8, 1.); }");

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const buffers = (places, extra, faces) => {
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    for (const [index, values] of [[0, places], [1, extra]]) {
      if (!values) continue;
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, 3, gl.FLOAT, false, 0, 0);
    }
    if (faces) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    }
    return array;
  };
  const rgba = (text, opacity) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255).concat(opacity);

  let reach = 1;
  const meshes = data.meshes.map((mesh) => {
    const steps = new Uint16Array(bytes(mesh.corners)), faces = new Uint32Array(bytes(mesh.faces));
    const places = Float32Array.from(steps, (v, i) => mesh.low[i % 3] + v * mesh.step[i % 3] - data.centre[i % 3]);
    const normals = new Float32Array(places.length);
    const corner = (n) => [places[3 * n], places[3 * n + 1], places[3 * n + 2]];
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [corner(faces[f]), corner(faces[f + 1]), corner(faces[f + 2])], n = cross(sub(b, a), sub(c, a));
      for (let k = 0; k < 3; k++) for (let i = 0; i < 3; i++) normals[3 * faces[f + k] + i] += n[i];
    }
    for (let n = 0; n < places.length; n += 3) reach = Math.max(reach, Math.hypot(places[n], places[n + 1], places[n + 2]));
    const middle = mesh.low.map((v, i) => v + 65535 / 2 * mesh.step[i] - data.centre[i]);
    return { array: buffers(places, normals, faces), count: faces.length, colour: rgba(mesh.colour, mesh.opacity), middle };
  });
  const views = data.views.map((view) => {
    const from = sub(view.source, data.centre), corners = view.detector.map((p) => sub(p, data.centre)), [a, b, c, d] = corners;
    const ends = [from, a, from, b, from, c, from, d, a, b, b, c, c, d, d, a].flat();
    const made = { from, lines: buffers(Float32Array.from(ends)), corners, right: unit(sub(b, a)), down: unit(sub(d, a)), image: null };
    if (view.image) {
      const quad = buffers(Float32Array.from(corners.flat()), Float32Array.from([0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0]), Uint32Array.from([0, 1, 2, 0, 2, 3]));
      const picture = new Image();
      picture.onload = () => {
        const texture = gl.createTexture();
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
        made.image = { quad, texture };
        draw();
      };
      picture.src = view.image;
    }
    return made;
  });

  // the eye: a direction from the centre of the scene, what is up, and how large the scene is drawn
  let eye, up, zoom;
  const seeFrom = (view) => {
    eye = unit(views[view].from);
    up = views[view].down.map((v) => -v);
    zoom = 1.3;
  };
  const labels = data.labels.map((label) => ({ ...label, at: sub(label.at, data.centre) }))
    .concat(views.map((view, n) => ({ text: data.views[n].name, at: view.from, beam: true })));
  const spans = labels.map((label) => {
    const span = document.createElement("span");
    span.textContent = label.text;
    return box.querySelector(".labels").appendChild(span);
  });
  const beams = document.getElementById("beams");

  function draw() {
    const width = Math.round(canvas.clientWidth * devicePixelRatio), height = Math.round(canvas.clientHeight * devicePixelRatio);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const right = unit(cross(up, eye)), above = cross(eye, right), far = 6 * reach;
    const look = [right[0], above[0], eye[0], 0, right[1], above[1], eye[1], 0, right[2], above[2], eye[2], 0, 0, 0, -3.2 * reach / zoom, 1];
    const near = 0.05 * reach, f = 2.8, wide = Math.max(width / height, 1);
    const tall = wide * height / width, last = 2 * far + 3.2 * reach / zoom;
    const lens = [f / wide, 0, 0, 0, 0, f / tall, 0, 0, 0, 0, (near + last) / (near - last), -1, 0, 0, 2 * near * last / (near - last), 0];
    const clip = times(lens, look);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.063, 0.082, 0.11, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    const use = (made, colour) => {
      gl.useProgram(made);
      gl.uniformMatrix4fv(gl.getUniformLocation(made, "clip"), false, clip);
      if (colour) gl.uniform4fv(gl.getUniformLocation(made, "colour"), colour);
    };
    if (beams.checked) {
      for (const view of views) {
        use(line, rgba(data.beam, 1));
        gl.bindVertexArray(view.lines);
        gl.drawArrays(gl.LINES, 0, 16);
        if (!view.image) continue;
        use(screen);
        gl.bindTexture(gl.TEXTURE_2D, view.image.texture);
        gl.bindVertexArray(view.image.quad);
        gl.drawElements(gl.TRIANGLES, 6, gl.UNSIGNED_INT, 0);
      }
    }
    const surface = (mesh) => {
      use(solid, mesh.colour);
      gl.uniform3fv(gl.getUniformLocation(solid, "toward"), eye);
      gl.bindVertexArray(mesh.array);
      gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_INT, 0);
    };
    for (const mesh of meshes) if (mesh.colour[3] === 1) surface(mesh);
    gl.enable(gl.BLEND);
    for (const mesh of [...meshes].sort((a, b) => dot(eye, a.middle) - dot(eye, b.middle))) { // the farthest first
      if (mesh.colour[3] === 1) continue;
      gl.colorMask(false, false, false, false); // the nearest surface alone shines
      surface(mesh);
      gl.colorMask(true, true, true, true);
      gl.depthFunc(gl.LEQUAL);
      surface(mesh);
      gl.depthFunc(gl.LESS);
    }
    gl.disable(gl.BLEND);
    labels.forEach((label, n) => {
      const [x, y, z] = label.at, w = clip[3] * x + clip[7] * y + clip[11] * z + clip[15];
      const place = [0, 1].map((i) => (clip[i] * x + clip[4 + i] * y + clip[8 + i] * z + clip[12 + i]) / w);
      spans[n].style.left = `${50 + 50 * place[0]}%`;
      spans[n].style.top = `${50 - 50 * place[1]}%`;
      spans[n].hidden = w <= 0 || (label.beam && !beams.checked);
    });
  }

  const rotate = (sideways, upwards) => {
    for (const [axis, angle] of [[unit(up), -sideways], [unit(cross(up, eye)), -upwards]]) {
      const turned = turn(axis, angle);
      eye = unit(turned(eye));
      up = unit(turned(up));
    }
    draw();
  };
  const scale = (factor) => {
    zoom = Math.min(12, Math.max(0.2, zoom * factor));
    draw();
  };

  const fingers = new Map();
  const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    if (fingers.size === 2) {
      const apart = spread();
      fingers.set(event.pointerId, now);
      if (apart > 0) scale(spread() / apart);
    } else {
      fingers.set(event.pointerId, now);
      rotate((now.x - before.x) * 0.008, (now.y - before.y) * 0.008);
    }
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return; // the wheel alone scrolls the page
    event.preventDefault();
    scale(Math.exp(-event.deltaY * 0.002));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = 0.1, moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (moves[event.key]) rotate(...moves[event.key]);
    else if (event.key === "+" || event.key === "=") scale(1.25);
    else if (event.key === "-") scale(0.8);
    else return;
    event.preventDefault();
  });
  for (const button of document.querySelectorAll("[data-from]")) button.addEventListener("click", () => { seeFrom(Number(button.dataset.from)); draw(); });
  for (const button of document.querySelectorAll("[data-turn]")) button.addEventListener("click", () => rotate(Math.PI * Number(button.dataset.turn) / 180, 0));
  for (const button of document.querySelectorAll("[data-zoom]")) button.addEventListener("click", () => scale(Number(button.dataset.zoom)));
  beams.addEventListener("change", draw);
  new ResizeObserver(draw).observe(canvas);
  seeFrom(0);
  rotate(0.6, 0.25); // a little from the side: straight from the source, beam and detector hide one another
})();
