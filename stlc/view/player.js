"use strict";
(() => {
  const data = JSON.parse(document.getElementById("animation-data").textContent);
  const root = document.querySelector(".player"), dusk = matchMedia("(prefers-color-scheme: dark)");
  const find = (name) => [...root.querySelectorAll(name)];
  const canvases = find("canvas"), cursors = find(".cursor"), values = find(".value");
  const [slider] = find("input"), [clock] = find("output"), [play] = find("button.play");
  const outlines = data.panels.map(() => new Map()), pictures = data.panels.map(() => new Map());
  const last = data.times.length - 1, pace = data.pace;
  let now = 0, running = null;

  document.documentElement.classList.add("js");

  const ink = (color) => {
    const night = dusk.matches && data.dark[color.slice(0, 7)];
    return night ? night + color.slice(7) : color;
  };
  const outline = (panel, text) => {
    if (!outlines[panel].has(text)) outlines[panel].set(text, new Path2D(text));
    return outlines[panel].get(text);
  };
  const picture = (panel, address) => {
    if (!pictures[panel].has(address)) {
      const image = new Image();
      image.onload = () => paint(panel);
      image.src = address;
      pictures[panel].set(address, image);
    }
    return pictures[panel].get(address);
  };

  const paint = (panel) => {
    const tape = data.panels[panel], canvas = canvases[panel], context = canvas.getContext("2d");
    const dots = window.devicePixelRatio || 1, wide = canvas.clientWidth, scale = (wide * dots) / tape.width;
    const width = Math.round(wide * dots), height = Math.round((width * tape.height) / tape.width);
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = ink("#ffffff");
    context.fillRect(0, 0, width, height);
    for (const number of tape.frames[now]) {
      const [kind, ...rest] = tape.commands[number];
      if (kind === "p") {
        const [path, face, line, thick, dash, clip] = rest;
        context.save();
        context.setTransform(scale / 4, 0, 0, scale / 4, 0, 0);
        if (clip) context.clip(outline(panel, clip));
        if (face) {
          context.fillStyle = ink(face);
          context.fill(outline(panel, path));
        }
        if (line) {
          context.strokeStyle = ink(line);
          context.lineWidth = 4 * Math.max(thick, (0.7 * dots) / scale);
          context.lineCap = dash ? "butt" : "round";
          context.lineJoin = "round";
          context.setLineDash(dash ? dash.split(" ").map((part) => 4 * part) : []);
          context.stroke(outline(panel, path));
        }
        context.restore();
      } else if (kind === "t") {
        const [x, y, words, size, color, align, angle, bold] = rest;
        context.save();
        context.setTransform(1, 0, 0, 1, (x * scale) / 4, (y * scale) / 4);
        context.rotate((angle * Math.PI) / 180);
        context.font = `${bold ? "bold " : ""}${Math.max(size * scale, 9.5 * dots)}px system-ui, sans-serif`;
        context.textAlign = align;
        context.fillStyle = ink(color);
        context.fillText(words, 0, 0);
        context.restore();
      } else {
        const [x, y, w, h, address] = rest, image = picture(panel, address);
        if (image.complete) context.drawImage(image, x * scale, y * scale, w * scale, h * scale);
      }
    }
  };

  const show = (frame) => {
    now = Math.min(Math.max(Math.round(frame), 0), last);
    canvases.forEach((_, panel) => paint(panel));
    slider.value = now;
    clock.textContent = `${data.times[now].toFixed(data.digits)} s`;
    slider.setAttribute("aria-valuetext", clock.textContent);
    for (const cursor of cursors) cursor.style.left = `${(100 * data.times[now]) / (data.times[last] || 1)}%`;
    values.forEach((cell, row) => {
      const value = data.rows[row][now];
      cell.textContent = value === null || value === undefined ? "" : value;
      cell.classList.toggle("bad", typeof value === "string" && value.startsWith("-"));
    });
  };
  const stop = () => {
    cancelAnimationFrame(running);
    running = null;
    play.textContent = "Play";
  };
  const start = () => {
    if (now >= last) now = 0;
    const from = data.times[now], begun = performance.now();
    play.textContent = "Pause";
    const turn = () => {
      const time = from + ((performance.now() - begun) / 1000) * pace;
      let frame = now;
      while (frame < last && data.times[frame + 1] <= time) frame += 1;
      if (frame !== now) show(frame);
      if (now >= last) stop();
      else running = requestAnimationFrame(turn);
    };
    running = requestAnimationFrame(turn);
  };
  const seek = (time) => {
    stop();
    let frame = 0;
    while (frame < last && data.times[frame + 1] <= time + 1e-9) frame += 1;
    show(frame);
  };

  play.onclick = () => (running === null ? start() : stop());
  slider.oninput = () => {
    stop();
    show(Number(slider.value));
  };
  for (const step of find("button[data-step]")) {
    step.onclick = () => {
      stop();
      show(now + Number(step.dataset.step));
    };
  }
  for (const plot of find(".plot")) {
    const point = (event) => {
      const box = plot.getBoundingClientRect();
      seek(((event.clientX - box.left) / box.width) * data.times[last]);
    };
    plot.onpointerdown = (event) => {
      plot.setPointerCapture(event.pointerId);
      point(event);
    };
    plot.onpointermove = (event) => event.buttons && point(event);
  }
  for (const jump of document.querySelectorAll("button[data-at]")) {
    jump.onclick = () => {
      document.querySelectorAll("tr.here").forEach((row) => row.classList.remove("here"));
      jump.closest("tr")?.classList.add("here");
      seek(Number(jump.dataset.at));
      root.scrollIntoView({ block: "start", behavior: "smooth" });
    };
  }
  root.onkeydown = (event) => {
    if (event.target.closest("button, input, summary")) return;
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (step) show(now + step);
    else if (event.key === " ") play.click();
    else return;
    if (step) stop();
    event.preventDefault();
  };
  dusk.addEventListener("change", () => show(now));
  new ResizeObserver(() => show(now)).observe(root);
  show(0);
  const asked = /^#t=([0-9.]+)$/.exec(location.hash);
  if (asked) seek(Number(asked[1]));
  else if (!matchMedia("(prefers-reduced-motion: reduce)").matches) start();
})();
