"use strict";
(() => {
  const settings = JSON.parse(document.body.dataset.settings);
  const $ = (id) => document.getElementById(id), all = (selector, from = document) => [...from.querySelectorAll(selector)];
  const stacks = all(".stack"), first = stacks.find((stack) => stack.dataset.first);
  const told = $("told"), SVG = "http://www.w3.org/2000/svg";
  let shown = null; // the last state with its drawing
  let chosen = null; // the landmark that keys, Remove and the next press are for
  let active = stacks[0]; // the image that keys and buttons move objects in
  let busy = false, dragging = false, leaving = false, waiting = null; // a motion that the server does not know yet

  const tool = () => (document.querySelector("input[name=tool]:checked") || { value: "" }).value;
  const running = () => Boolean(shown && shown.progress && shown.progress.state === "running");
  const element = (name, attributes, parent) => {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    parent.append(made);
    return made;
  };
  const say = (words, wrong = false) => {
    told.textContent = words;
    told.classList.toggle("wrong", wrong);
  };
  const moving = () => (tool() === settings.all ? Object.keys(settings.centres || {}) : [tool()]);

  // What the server says

  const ask = async (address, content) => {
    const options = content && { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(content) };
    try {
      const answer = await fetch(address, options);
      const found = (answer.headers.get("content-type") || "").startsWith("application/json") ? await answer.json() : null;
      if (!found) say(await answer.text(), true);
      $("lost").hidden = true;
      return found;
    } catch {
      $("lost").hidden = false; // before it answered, or in the middle of its answer
      return null;
    }
  };
  // One after the other: each is sent with the revision that the one before has left.
  let sent = Promise.resolve();
  const post = (address, content) => (sent = sent.then(() => send(address, content)));
  const send = async (address, content) => {
    const state = await ask(address, { ...content, revision: shown.revision });
    if (!state) return;
    show(state);
    if (state.message) say(state.message, true);
    else if (address === "change") say("");
  };
  // An answer may be overtaken by a later one: what is shown never goes back.
  const older = (state) => Boolean(shown) && (state.shown[0] - shown.shown[0] || state.shown[1] - shown.shown[1]) < 0;
  const show = (state) => {
    if (older(state)) return;
    const before = shown && shown.progress && shown.progress.state, decided = shown && shown.decided;
    shown = { ...shown, ...state };
    const progress = shown.progress, on = running();
    document.body.classList.toggle("busy", on);
    for (const button of all(".bar button")) button.disabled = on;
    $("cancel").disabled = !on;
    $("progress").hidden = !on;
    if (on) {
      $("progress").value = progress.share;
      say(`Registering: ${progress.step}`);
    } else if (progress && before === "running") {
      say(progress.words || "Registered.", progress.state !== "done");
    }
    if (shown.digest !== settings.digest || (decided !== null && decided !== shown.decided)) renew();
    if (state.drawing) draw();
    buttons();
  };
  // A new result or decision needs a new page; what somebody is typing is not thrown away.
  const renew = () => {
    const note = document.querySelector("textarea[name=note]");
    if (note && note.value) say("There is a new result or decision. Reload the page to see it.", true);
    else if (!leaving) {
      leaving = true; // a second reload would begin again with what the first waits for
      location.reload();
    }
  };
  const poll = async () => {
    if (leaving) return;
    if (!busy && !dragging && shown) {
      const state = await ask("state");
      if (state && !busy && !dragging) {
        const stale = String(state.shown) !== String(shown.shown);
        const whole = stale ? await ask("drawing") : state;
        if (whole && !busy && !dragging) show(whole);
      }
    }
    setTimeout(poll, 700);
  };

  // What is drawn

  const draw = () => {
    const { views, landmarks } = shown.drawing;
    for (const stack of stacks) {
      const view = views[stack.dataset.view - 1];
      stack.classList.toggle("placed", Boolean(view));
      stack.querySelector(".unknown").hidden = Boolean(view);
      for (const layer of all("img.edges", stack)) {
        const source = view && view.edges[layer.dataset.layer];
        layer.hidden = !source || !$("edges").checked;
        if (source) layer.src = source;
        layer.style.transform = "";
      }
      drawLines(stack, view);
      drawHandle(stack, view);
    }
    settings.centres = (views.find(Boolean) || { centres: {} }).centres;
    if (first) drawMarks(landmarks);
    hint();
  };
  const unit = (stack) => stack.dataset.width / 100;
  const drawLines = (stack, view) => {
    const group = stack.querySelector(".lines"), u = unit(stack);
    group.replaceChildren();
    for (const line of (view && view.lines[stack.dataset.kind]) || []) {
      const [[x0, y0], [x1, y1]] = line.pixels, stroke = settings[line.name];
      element("path", { d: `M${x0} ${y0}L${x1} ${y1}`, stroke, ...(line.name === "path" && { "stroke-dasharray": "8 4" }) }, group);
      const end = line.name === "path" ? `M${x0 - u} ${y0}a${u} ${u} 0 1 0 ${2 * u} 0a${u} ${u} 0 1 0 ${-2 * u} 0` : `M${x1 - u} ${y1}h${2 * u}M${x1} ${y1 - u}v${2 * u}`;
      element("path", { d: end, stroke }, group);
    }
  };
  const centre = (stack) => {
    const view = shown.drawing.views[stack.dataset.view - 1];
    if (!view || !tool()) return null;
    return view.centres[moving()[0]] || null;
  };
  const drawHandle = (stack) => {
    const group = stack.querySelector(".handle"), place = centre(stack), u = unit(stack);
    group.replaceChildren();
    if (!place || running()) return;
    const [x, y] = place, far = 16 * u;
    element("path", { d: `M${x - 2 * u} ${y}h${4 * u}M${x} ${y + 2 * u}V${y - far}` }, group);
    element("circle", { cx: x, cy: y - far, r: 1.8 * u, class: "turn" }, group);
  };
  const drawMarks = (landmarks) => {
    const group = first.querySelector(".marks"), u = unit(first);
    group.replaceChildren();
    for (const [name, [x, y]] of Object.entries(landmarks)) {
      const mark = element("g", { class: name === chosen ? "mark chosen" : "mark", "data-name": name, transform: `translate(${x} ${y})` }, group);
      element("path", { d: `M${-1.2 * u} 0h${2.4 * u}M0 ${-1.2 * u}v${2.4 * u}` }, mark);
      element("circle", { r: 2.2 * u }, mark);
      element("text", { x: 2.4 * u, y: -1.6 * u, "font-size": 3 * u, "stroke-width": 0.6 * u }, mark).textContent = name;
    }
  };
  const buttons = () => {
    const there = shown.drawing ? shown.drawing.landmarks : {};
    for (const button of all("[data-landmark]")) {
      button.classList.toggle("there", button.dataset.landmark in there);
      button.setAttribute("aria-pressed", String(button.dataset.landmark === chosen));
    }
    if ($("remove")) $("remove").disabled = running() || !(chosen in there);
    $("moves").hidden = !tool();
    $("active").textContent = `view ${active ? active.dataset.view : 1}`;
    document.body.classList.toggle("drags", Boolean(tool()) && !running());
    document.body.classList.toggle("arms", chosen !== null && !(chosen in there) && !running());
  };
  const choose = (name) => {
    chosen = name;
    drawMarks(shown.drawing.landmarks);
    buttons();
  };

  // Objects: motions gather while the server draws the last one

  let moved = Promise.resolve(); // once the server knows all motions
  const nothing = () => ({ shift_px: [0, 0], turn_deg: 0, tilt_deg: [0, 0], depth_mm: 0 });
  const sendMoves = async () => {
    busy = true;
    while (waiting) {
      const move = waiting;
      waiting = null;
      await post("change", { move });
    }
    busy = false;
  };
  const move = (stack, part) => {
    if (running() || !tool() || !shown.drawing.views[stack.dataset.view - 1]) return;
    const view = Number(stack.dataset.view);
    if (!waiting || waiting.view !== view || waiting.what !== tool()) waiting = { what: tool(), view, ...nothing() };
    const sum = (a, b = [0, 0]) => [a[0] + b[0], a[1] + b[1]];
    waiting.shift_px = sum(waiting.shift_px, part.shift_px);
    waiting.tilt_deg = sum(waiting.tilt_deg, part.tilt_deg);
    waiting.turn_deg += part.turn_deg || 0;
    waiting.depth_mm += part.depth_mm || 0;
    hint();
    if (!busy) moved = sendMoves();
  };
  // Until the server has drawn it, the picture of the edges itself is moved.
  const hint = () => {
    if (!waiting) return;
    const [dx, dy] = waiting.shift_px;
    for (const stack of stacks.filter((one) => Number(one.dataset.view) === waiting.view)) {
      const scale = stack.clientWidth / stack.dataset.width, [x, y] = centre(stack) || [0, 0];
      for (const layer of all("img.edges", stack)) {
        if (!moving().includes(layer.dataset.layer)) continue;
        layer.style.transformOrigin = `${x * scale}px ${y * scale}px`;
        layer.style.transform = `translate(${dx * scale}px, ${dy * scale}px) rotate(${waiting.turn_deg}deg)`;
      }
    }
  };
  const place = (stack, event) => {
    const box = stack.getBoundingClientRect(), scale = stack.dataset.width / box.width;
    return [(event.clientX - box.left) * scale - 0.5, (event.clientY - box.top) * scale - 0.5];
  };

  for (const stack of stacks) {
    const svg = stack.querySelector("svg");
    let drag = null;
    svg.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || running() || !shown) return;
      active = stack;
      const at = place(stack, event), mark = event.target.closest(".mark");
      if (mark) {
        choose(mark.dataset.name);
        drag = { kind: "mark", name: mark.dataset.name, at };
      } else if (stack === first && chosen !== null && !(chosen in shown.drawing.landmarks)) {
        post("change", { mark: { name: chosen, column: at[0], row: at[1] } });
      } else if (tool() && centre(stack)) {
        const [x, y] = centre(stack);
        drag = event.target.classList.contains("turn")
          ? { kind: "turn", x, y, angle: Math.atan2(at[1] - y, at[0] - x) }
          : { kind: "shift", at };
      } else if (chosen !== null) choose(null);
      if (drag) {
        dragging = true;
        svg.setPointerCapture(event.pointerId);
        event.preventDefault();
        stack.focus({ preventScroll: true });
      }
      buttons();
    });
    svg.addEventListener("pointermove", (event) => {
      if (!drag) return;
      const at = place(stack, event);
      if (drag.kind === "mark") {
        drag.to = at;
        const mark = first.querySelector(`.mark[data-name="${CSS.escape(drag.name)}"]`);
        if (mark) mark.setAttribute("transform", `translate(${at[0]} ${at[1]})`);
      } else if (drag.kind === "shift") {
        move(stack, { shift_px: [at[0] - drag.at[0], at[1] - drag.at[1]] });
        drag.at = at;
      } else {
        const angle = Math.atan2(at[1] - drag.y, at[0] - drag.x), turned = angle - drag.angle;
        move(stack, { turn_deg: (Math.atan2(Math.sin(turned), Math.cos(turned)) * 180) / Math.PI });
        drag.angle = angle;
      }
    });
    const end = () => {
      if (!drag) return;
      if (drag.kind === "mark" && drag.to) post("change", { mark: { name: drag.name, column: drag.to[0], row: drag.to[1] } });
      drag = null;
      dragging = false;
    };
    svg.addEventListener("pointerup", end);
    svg.addEventListener("pointercancel", end);
    stack.addEventListener("keydown", (event) => key(stack, event));
  }
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const MOVES = {
    "+": { depth_mm: 5 }, "=": { depth_mm: 5 }, "-": { depth_mm: -5 }, ",": { turn_deg: -1 }, ".": { turn_deg: 1 },
    w: { tilt_deg: [1, 0] }, s: { tilt_deg: [-1, 0] }, a: { tilt_deg: [0, 1] }, d: { tilt_deg: [0, -1] },
  };
  const key = (stack, event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || running() || !shown) return;
    const arrow = ARROWS[event.key], there = shown.drawing.landmarks[chosen];
    active = stack;
    if (there && (arrow || event.key === "Delete")) {
      const step = event.shiftKey ? 10 : 1;
      if (arrow) post("change", { mark: { name: chosen, column: there[0] + step * arrow[0], row: there[1] + step * arrow[1] } });
      else post("change", { unmark: chosen });
    } else if (tool() && arrow) {
      const step = (event.shiftKey ? 5 : 1) / settings.pixel_mm;
      move(stack, { shift_px: [step * arrow[0], step * arrow[1]] });
    } else if (tool() && MOVES[event.key.toLowerCase()]) move(stack, MOVES[event.key.toLowerCase()]);
    else return;
    event.preventDefault();
    buttons();
  };

  // Buttons

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button || !shown) return;
    if (button.dataset.landmark) choose(chosen === button.dataset.landmark ? null : button.dataset.landmark);
    else if (button.dataset.move) move(active, JSON.parse(button.dataset.move));
    else if (button.dataset.do) {
      say(button.dataset.do === "find" ? "Looking for landmarks …" : "");
      moved.then(() => post("change", { do: button.dataset.do }));
    } else if (button.dataset.start) moved.then(() => post("start", { source: button.dataset.start }));
    else if (button.id === "cancel") post("cancel", {});
    else if (button.id === "remove") post("change", { unmark: chosen });
    else if (button.classList.contains("enlarge")) {
      const large = button.closest(".panel").classList.toggle("large");
      button.setAttribute("aria-pressed", String(large));
    }
  });
  for (const input of all("input[name=tool]")) {
    input.addEventListener("change", () => {
      if (tool()) chosen = null;
      draw();
      buttons();
    });
  }
  $("edges").addEventListener("change", () => draw());
  ask("drawing").then((state) => {
    if (state) show(state);
    poll();
  });
})();
