// Draws what was computed at the place where the sliders are: no request, no library.
(() => {
  const known = JSON.parse(document.getElementById("explored").textContent);
  const box = document.querySelector(".explore");
  const sliders = [...box.querySelectorAll("input")];
  const names = Object.keys(known.axes);
  const W = 460, H = 190, LEFT = 58, RIGHT = 10, TOP = 24, BOTTOM = 34;
  const range = lists => {
    const all = lists.flat(), low = Math.min(...all), high = Math.max(...all), pad = (high - low || 1) * 0.06;
    return [low - pad, high + pad];
  };
  // one range of each picture for all places, so that a move is seen as a move
  const runs = known.places.filter(place => place.t);
  const median = (values, share) => [...values].sort((a, b) => a - b)[Math.floor(share * (values.length - 1))];
  const usual = name => [0, range([[
    median(runs.map(r => Math.min(...r[name])), 0.3), median(runs.map(r => Math.max(...r[name])), 0.7)]])];
  const limits = {
    phi: [range(known.places.map(p => p.phi.map(q => q[0]))), range(known.places.map(p => p.phi.map(q => q[1])))],
    y: usual("y"),
    e: usual("e"),
  };

  function picture(title, x, y, xLabel, yLabel, inside) {
    const fx = v => LEFT + (v - x[0]) / (x[1] - x[0]) * (W - LEFT - RIGHT);
    const fy = v => H - BOTTOM - (v - y[0]) / (y[1] - y[0]) * (H - TOP - BOTTOM);
    const ticks = ([low, high]) => {
      const size = 10 ** Math.floor(Math.log10((high - low) / 2));
      const step = [5, 2, 1].map(k => k * size).find(k => (high - low) / k >= 2);
      const first = Math.ceil(low / step), count = Math.floor(high / step) - first + 1;
      return Array.from({ length: count }, (_, k) => Number(((first + k) * step).toPrecision(6)));
    };
    const marks = ticks(x).map(v => `<line class="grid" x1="${fx(v)}" x2="${fx(v)}" y1="${TOP}" y2="${H - BOTTOM}"/>` +
        `<text x="${fx(v)}" y="${H - BOTTOM + 13}" text-anchor="middle">${v}</text>`).join("") +
      (yLabel === null ? "" : ticks(y).map(v =>
        `<line class="grid" x1="${LEFT}" x2="${W - RIGHT}" y1="${fy(v)}" y2="${fy(v)}"/>` +
        `<text x="${LEFT - 4}" y="${fy(v) + 4}" text-anchor="end">${v}</text>`).join(""));
    return `<svg viewBox="0 0 ${W} ${H}" role="img" aria-label="${title}"><text class="title" x="${LEFT}" y="14">${title}` +
      `</text>${marks}<svg x="${LEFT}" y="${TOP}" width="${W - LEFT - RIGHT}" height="${H - TOP - BOTTOM}" ` +
      `viewBox="${LEFT} ${TOP} ${W - LEFT - RIGHT} ${H - TOP - BOTTOM}">${inside(fx, fy)}</svg>` +
      `<text x="${(LEFT + W - RIGHT) / 2}" y="${H - 4}" text-anchor="middle">${xLabel}</text></svg>`;
  }
  const line = (kind, xs, ys) => (fx, fy) =>
    `<polyline class="${kind}" points="${xs.map((v, k) => `${fx(v).toFixed(1)},${fy(ys[k]).toFixed(1)}`).join(" ")}"/>`;
  const text = value => value.replace(/[&<>"]/g, c => `&#${c.charCodeAt(0)};`);

  function cells(place, time) {
    const step = (H - TOP - BOTTOM) / place.cells.length;
    return picture("in which cell the plant is", time, [0, 1], "time (s)", null, fx => place.cells.map((cell, k) =>
      cell.bars.map(([t, length]) => `<rect class="bar" x="${fx(t)}" width="${Math.max(fx(t + length) - fx(t), 0.5)}" ` +
        `y="${TOP + k * step + 2}" height="${step - 4}"/>`).join("") +
      `<text class="over" x="${LEFT + 4}" y="${TOP + (k + 0.5) * step + 4}">` +
      `${text(cell.name)}, ${Math.round(100 * cell.share)} %</text>`).join(""));
  }

  function draw() {
    let index = 0;
    sliders.forEach((slider, k) => {
      const grid = known.axes[names[k]];
      slider.previousElementSibling.textContent = Number(grid[slider.value].toPrecision(6));
      index = index * grid.length + Number(slider.value);
    });
    const place = known.places[index], s = place.phi.map(p => p[0]), phi = place.phi.map(p => p[1]);
    const proved = place.verdict === "proved";
    const verdict = { infeasible: "proved impossible", undecided: "undecided" }[place.verdict] || place.verdict;
    box.querySelector(".verdict").innerHTML =
      `<b class="${proved ? "yes" : "no"}">${text(verdict)}</b> ${text(place.said)}` +
      (place.ran ? `<br><b>simulated</b> ${text(place.ran)}` : "");
    const pictures = [picture(`${text(place.element)}: φ(s)`, ...limits.phi, "s", "", line("actual", s, phi))];
    if (place.t) {
      const time = [place.t[0], place.t[place.t.length - 1]];
      pictures.push(
        picture("y, and y_d dashed", time, limits.y[1], "time (s)", "", (fx, fy) =>
          line("actual", place.t, place.y)(fx, fy) + line("desired", place.t, place.y_d)(fx, fy)),
        picture("y − y_d", time, limits.e[1], "time (s)", "", line("actual", place.t, place.e)),
        cells(place, time));
    }
    box.querySelector(".pictures").innerHTML = pictures.join("");
  }
  sliders.forEach(slider => slider.addEventListener("input", draw));
  draw();
})();
