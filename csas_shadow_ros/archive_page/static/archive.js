"use strict";
// The page of an archive. Everything comes from its own server; text from the catalogue is never markup.
(() => {
  const $ = id => document.getElementById(id);
  const form = $("asked"), canvas = $("map"), body = $("rows");
  const COLOURS = { "object": "#ffcd6e", "undecided": "#ff8f66", "no object": "#6f8797", "": "#888" };
  const EARTH_M = 6371008.8;
  const state = { points: [], chosen: "", centre: null, scale: 1, asked: 0, answered: 0 };

  // -- the table

  const cell = (row, text, kind) => {
    const made = row.insertCell();
    if (kind) made.className = kind;
    made.textContent = text;
    return made;
  };
  const metres = value => (value === null ? "–" : value.toFixed(2));

  const fill = rows => {
    body.textContent = "";
    for (const one of rows) {
      const row = body.insertRow();
      row.dataset.results = one.results || "";
      const picture = row.insertCell();
      if (one.results && one.status === "done") {
        const image = document.createElement("img");
        image.loading = "lazy";
        image.alt = "";
        image.src = `api/thumbnail.png?results=${encodeURIComponent(one.results)}`;
        picture.append(image);
      }
      cell(row, one.time || "–");
      const name = row.insertCell(), label = one.name + (one.number > 1 ? ` (run ${one.number})` : "");
      if (one.results && one.status === "done") {
        const button = document.createElement("button");
        button.textContent = label;
        button.title = "Open this run";
        button.onclick = () => open(one.results);
        name.append(button);
      } else name.textContent = label;
      cell(row, one.status === "done" ? one.verdict + (one.object ? ` ${one.object}` : "") : one.status);
      cell(row, one.quality || one.reason || "", one.quality ? "" : "reason").title =
        one.reasons || one.why_no_object || one.reason || "";
      cell(row, one.object === null ? "–" : [one.length_m, one.width_m, one.height_m].map(metres).join(" × "));
      const place = one.place_latitude_deg;
      cell(row, place === null ? "–" : `${place.toFixed(6)} ${one.place_longitude_deg.toFixed(6)}`);
      row.onclick = () => choose(one.results || "");
    }
  };

  const choose = (results, show) => {
    state.chosen = results;
    for (const row of body.rows) {
      const mine = results !== "" && row.dataset.results === results;
      row.classList.toggle("chosen", mine);
      if (mine && show) row.scrollIntoView({ block: "nearest" });
    }
    draw();
  };

  const open = async results => {
    // Before the answer: a window that opens later is a pop-up to the browser.
    const page = window.open("", "_blank");
    const answer = await fetch("api/open", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ results }),
    });
    if (!answer.ok) {
      page?.close();
      $("error").textContent = await answer.text();
      return;
    }
    const { url } = await answer.json();
    if (page) page.location.replace(url); else location.assign(url);
  };

  // -- what is asked

  const choices = (name, values) => {
    const select = form.elements[name], before = select.value;
    const known = [...select.options].map(option => option.value).slice(1);
    if (select.options.length && known.join("\n") === values.join("\n")) return;
    select.textContent = "";
    for (const value of ["", ...values]) select.add(new Option(value || "all", value));
    select.value = values.includes(before) ? before : "";
  };

  const ask = async () => {
    const number = ++state.asked;
    const query = new URLSearchParams([...new FormData(form)].filter(([, value]) => value.trim()));
    let answer, said;
    try {
      answer = await fetch(`api/rows?${query}`);
      said = answer.ok ? await answer.json() : await answer.text();
    } catch (error) {
      answer = { ok: false };
      said = "the server does not answer";
    }
    if (number < state.answered) return; // a later question was answered first
    state.answered = number;
    $("error").textContent = answer.ok ? "" : said;
    if (!answer.ok) return;
    document.title = $("title").textContent = said.title;
    $("count").textContent = `${said.count} rows`;
    $("more").hidden = said.rows.length >= said.count;
    $("more").textContent = `The first ${said.rows.length} of ${said.count}; filters leave fewer.`;
    for (const [name, values] of Object.entries(said.choices)) choices(name, values);
    fill(said.rows);
    state.points = said.points.map(([lat, lon, verdict, results]) => ({ lat, lon, verdict, results }));
    $("no-map").hidden = state.points.length > 0;
    if (state.centre === null) fit();
    choose(state.chosen);
  };
  let later = 0;
  const soon = wait => { clearTimeout(later); later = setTimeout(ask, wait); };
  form.oninput = () => soon(300);
  form.onreset = () => { state.centre = null; soon(0); };
  form.onsubmit = event => { event.preventDefault(); soon(0); };

  // -- the map: equirectangular round its middle, in metres; no tiles, nothing from elsewhere

  const plane = point => {
    const { lat, lon } = state.centre, rad = Math.PI / 180;
    const around = ((point.lon - lon + 540) % 360) - 180;
    return [around * rad * EARTH_M * Math.cos(lat * rad), (point.lat - lat) * rad * EARTH_M];
  };
  const screen = point => {
    const [x, y] = plane(point);
    return [canvas.clientWidth / 2 + x * state.scale, canvas.clientHeight / 2 - y * state.scale];
  };

  const fit = () => {
    if (!state.points.length) return;
    state.centre = { lat: state.points[0].lat, lon: state.points[0].lon };
    let [left, right, low, high] = [0, 0, 0, 0];
    for (const point of state.points) {
      const [x, y] = plane(point);
      left = Math.min(left, x); right = Math.max(right, x); low = Math.min(low, y); high = Math.max(high, y);
    }
    move((left + right) / 2, (low + high) / 2);
    const width = Math.max(right - left, 20), height = Math.max(high - low, 20);
    state.scale = 0.85 * Math.min(canvas.clientWidth / width, canvas.clientHeight / height);
  };
  const move = (x, y) => {
    const { lat, lon } = state.centre, deg = 180 / Math.PI / EARTH_M;
    state.centre = {
      lat: Math.max(-89, Math.min(89, lat + y * deg)),
      lon: ((lon + x * deg / Math.cos(lat * Math.PI / 180) + 540) % 360) - 180,
    };
  };
  const zoom = (factor, px, py) => {
    if (state.centre === null) return;
    const scale = Math.max(1e-5, Math.min(2e3, state.scale * factor));
    const dx = px - canvas.clientWidth / 2, dy = canvas.clientHeight / 2 - py;
    move(dx / state.scale - dx / scale, dy / state.scale - dy / scale);
    state.scale = scale;
    draw();
  };

  const round = length => {
    const ten = 10 ** Math.floor(Math.log10(length));
    return ten * (length / ten >= 5 ? 5 : length / ten >= 2 ? 2 : 1);
  };
  let frame = 0;
  const draw = () => { frame ||= requestAnimationFrame(paint); };
  const paint = () => {
    frame = 0;
    const density = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * density;
    canvas.height = height * density;
    const g = canvas.getContext("2d");
    g.scale(density, density);
    if (state.centre === null) return;
    g.font = "12px system-ui, sans-serif";
    grid(g, width, height);
    for (const point of state.points) {
      const [x, y] = screen(point);
      if (x < -9 || y < -9 || x > width + 9 || y > height + 9) continue;
      g.fillStyle = COLOURS[point.verdict] || COLOURS[""];
      g.beginPath();
      g.arc(x, y, 4, 0, 7);
      g.fill();
      if (point.results && point.results === state.chosen) {
        g.strokeStyle = "#fff";
        g.lineWidth = 2;
        g.beginPath();
        g.arc(x, y, 8, 0, 7);
        g.stroke();
      }
    }
    const bar = round(0.3 * width / state.scale);
    g.fillStyle = g.strokeStyle = "#ddd";
    g.lineWidth = 2;
    g.strokeRect(12, height - 14, bar * state.scale, 0.01);
    g.fillText(bar >= 1000 ? `${bar / 1000} km` : `${bar} m`, 12, height - 20);
    g.fillText("N ↑", width - 28, 18);
  };
  const grid = (g, width, height) => {
    const { lat, lon } = state.centre, rad = Math.PI / 180;
    const north = height / 2 / state.scale / EARTH_M / rad, east = width / 2 / state.scale / EARTH_M / rad / Math.cos(lat * rad);
    const step = round(north / 2), digits = Math.max(0, Math.ceil(-Math.log10(step)));
    g.strokeStyle = "#2f3338";
    g.fillStyle = "#8b939b";
    g.lineWidth = 1;
    const line = (from, to, text, at) => {
      g.beginPath();
      g.moveTo(...from);
      g.lineTo(...to);
      g.stroke();
      g.fillText(text, ...at);
    };
    for (let k = Math.ceil((lat - north) / step); k <= (lat + north) / step; k++) {
      const [, y] = screen({ lat: k * step, lon });
      line([0, y], [width, y], `${(k * step).toFixed(digits)}°`, [4, y - 3]);
    }
    if (east > 180) return;
    for (let k = Math.ceil((lon - east) / step), n = 0; k <= (lon + east) / step && n < 100; k++, n++) {
      const [x] = screen({ lat, lon: k * step });
      line([x, 0], [x, height], n % 2 ? "" : `${(((k * step + 540) % 360) - 180).toFixed(digits)}°`, [x + 3, 12]);
    }
  };

  let held = null;
  canvas.onpointerdown = event => { held = { x: event.clientX, y: event.clientY, moved: 0 }; canvas.setPointerCapture(event.pointerId); };
  canvas.onpointermove = event => {
    if (!held || state.centre === null) return;
    const dx = event.clientX - held.x, dy = event.clientY - held.y;
    held = { x: event.clientX, y: event.clientY, moved: held.moved + Math.abs(dx) + Math.abs(dy) };
    move(-dx / state.scale, dy / state.scale);
    draw();
  };
  canvas.onpointerup = event => {
    const click = held && held.moved < 4;
    held = null;
    if (!click) return;
    const box = canvas.getBoundingClientRect();
    let best = null, least = 12;
    for (const point of state.points) {
      const [x, y] = screen(point), away = Math.hypot(x - event.clientX + box.left, y - event.clientY + box.top);
      if (away < least) [best, least] = [point, away];
    }
    choose(best ? best.results : "", true);
  };
  canvas.ondblclick = () => { if (state.chosen) open(state.chosen); };
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    const box = canvas.getBoundingClientRect();
    zoom(Math.exp(-event.deltaY / 400), event.clientX - box.left, event.clientY - box.top);
  }, { passive: false });
  canvas.onkeydown = event => {
    const [w, h] = [canvas.clientWidth / 2, canvas.clientHeight / 2];
    const by = { ArrowLeft: [-40, 0], ArrowRight: [40, 0], ArrowUp: [0, 40], ArrowDown: [0, -40] }[event.key];
    if (event.key === "+" || event.key === "-") zoom(event.key === "+" ? 1.5 : 1 / 1.5, w, h);
    else if (event.key === "0") { fit(); draw(); }
    else if (event.key === "Enter" && state.chosen) open(state.chosen);
    else if (by && state.centre) { move(by[0] / state.scale, by[1] / state.scale); draw(); }
    else return;
    event.preventDefault();
  };
  new ResizeObserver(draw).observe(canvas);
  window.archive = { state, screen };
  ask();
})();
