// The network view of the KPI page: the slider, the controllers, the play button.
(function () {
  "use strict";
  const data = JSON.parse(document.getElementById("network-data").textContent);
  const slider = document.getElementById("moment");
  const clock = document.getElementById("clock");
  const play = document.getElementById("play");
  const views = Array.from(document.querySelectorAll(".view"));
  const N = data.lines.length, F = data.times.length;
  const codes = {};
  for (const name of Object.keys(data.controllers)) {
    const text = atob(data.controllers[name]);
    const values = new Uint16Array(text.length / 2);
    for (let k = 0; k < values.length; k++) {
      values[k] = text.charCodeAt(2 * k) + 256 * text.charCodeAt(2 * k + 1);
    }
    codes[name] = values;
  }

  function deviation(name, frame, line) {
    const code = codes[name][frame * N + line];
    return code > 65534 ? NaN : (2 * code / 65534 - 1) * data.limit;
  }
  function signed(value) {
    return (value < 0 ? "−" : "+") + Math.abs(value).toFixed(2);
  }
  function when(seconds) {
    const total = Math.round(seconds), h = Math.floor(total / 3600);
    const min = Math.floor(total / 60) % 60, s = total % 60;
    const parts = [];
    if (h) parts.push(h + " h");
    if (h || min) parts.push(min + " min");
    if (s || !parts.length) parts.push(s + " s");
    return parts.join(" ");
  }

  function draw(view) {
    const name = view.dataset.controller, frame = Number(slider.value);
    const lines = view.querySelectorAll("g.line");
    let warm = -1, cool = -1, outside = 0, unknown = 0;
    for (let i = 0; i < N; i++) {
      const value = deviation(name, frame, i), known = !Number.isNaN(value), line = lines[i];
      const part = known ? Math.max(-1, Math.min(1, value / data.span)) : 0;
      const level = Math.round((part + 1) / 2 * (data.palette.length - 1));
      line.firstElementChild.nextElementSibling.setAttribute(
        "fill", known ? data.palette[level] : data.unknown);
      line.classList.toggle("dark", known && Math.abs(part) > 0.62);
      line.classList.toggle("warm", known && value > data.band);
      line.classList.toggle("cool", known && value < -data.band);
      line.firstElementChild.textContent = "line " + data.lines[i] + ": " +
        (known ? signed(value) + " K" : "not known");
      if (!known) { unknown++; continue; }
      if (Math.abs(value) > data.band) outside++;
      if (warm < 0 || value > deviation(name, frame, warm)) warm = i;
      if (cool < 0 || value < deviation(name, frame, cool)) cool = i;
    }
    let text = "No values.";
    if (warm >= 0) {
      text = "Warmest: line " + data.lines[warm] + ", " + signed(deviation(name, frame, warm)) +
        " K. Coolest: line " + data.lines[cool] + ", " + signed(deviation(name, frame, cool)) +
        " K. " + (outside ? outside + " of " + N + " outside" : "All inside") + " ±" + data.band + " K." +
        (unknown ? " " + unknown + " not known." : "");
    }
    view.querySelector(".reading").textContent = text;
    view.querySelector("svg.net").setAttribute("aria-label",
      "Network with " + name + " at t = " + when(data.times[frame]) + ". " + text);
    const cursor = view.querySelector(".cursor"), x = 100 * frame / Math.max(F - 1, 1);
    cursor.setAttribute("x1", x);
    cursor.setAttribute("x2", x);
  }
  function trace(view) { // the largest deviation over time, under the network
    const name = view.dataset.controller, points = [];
    for (let f = 0; f < F; f++) {
      let worst = 0;
      for (let i = 0; i < N; i++) {
        const value = Math.abs(deviation(name, f, i));
        if (value > worst) worst = value;
      }
      points.push((100 * f / Math.max(F - 1, 1)).toFixed(2) + "," +
        (30 - 28 * Math.min(1, worst / data.span)).toFixed(2));
    }
    view.querySelector(".trace").setAttribute("points", points.join(" "));
  }
  function show() {
    const text = when(data.times[Number(slider.value)]);
    clock.textContent = "t = " + text;
    slider.setAttribute("aria-valuetext", text);
    views.forEach(draw);
  }
  function choose(name) {
    const main = views[0];
    main.dataset.controller = name;
    main.querySelector(".who").textContent = name;
    trace(main);
    draw(main);
  }

  slider.max = F - 1;
  slider.addEventListener("input", function () { stop(); show(); });
  document.querySelectorAll("input[name=controller]").forEach(function (button) {
    button.addEventListener("change", function () { choose(button.value); });
  });
  let timer = 0;
  function stop() {
    clearInterval(timer);
    timer = 0;
    play.textContent = "▶ Play";
  }
  play.addEventListener("click", function () {
    if (timer) { stop(); return; }
    if (Number(slider.value) >= F - 1) slider.value = 0;
    play.textContent = "❚❚ Pause";
    timer = setInterval(function () {
      slider.value = Number(slider.value) + 1;
      show();
      if (Number(slider.value) >= F - 1) stop();
    }, 80);
  });
  views.forEach(trace);
  show();
  document.getElementById("controls").hidden = false;
})();
