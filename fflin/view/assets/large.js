// One chart of the panel in the height of the window: its cursor reads all curves, its legend hides
// them, and what is shown is saved as a .csv file.

function makeLarge(info, seek, marks) {
  const box = element("section", { id: "large", hidden: true }), canvas = element("canvas");
  const heading = element("b"), clock = element("output"), curves = element("div", { className: "curves" });
  const all = element("button", {}, "all"), save = element("button", { title: "save the curves that are shown" }, ".csv");
  const close = element("button", { className: "close", title: "close" }, "✕");
  box.append(element("div", { className: "head" }, heading, clock, all, save, close), element("div", { className: "chart" }, canvas, curves));
  document.getElementById("overlay").append(box);

  let plot = null, hidden = new Set(), rows = [], now = [0, info.t[0]], pointed = null;
  const shown = () => plot.lines.filter((line) => !hidden.has(line));
  const kinds = [makeChart, makeRaster].map((make) => make(canvas, info.t, shown, marks, true));
  let chart = kinds[0];
  const nameOf = (line) => line.label || plot.title;
  const show = (i = now[0], time = now[1]) => {
    now = [i, time];
    if (box.hidden) return;
    const { i: at, time: when } = pointed || { i, time };
    chart.show(at, when);
    clock.textContent = `t = ${figure(when, 4)} s`;
    rows.forEach(({ row, line, value }) => {
      const reference = line.reference.length ? ` (${figure(line.reference[at], 3)})` : "";
      value.textContent = chart.reading(line, at, when) + reference;
      row.classList.toggle("near", Boolean(pointed) && pointed.line === line);
    });
  };
  const refresh = () => {
    rows.forEach(({ row, line }) => row.setAttribute("aria-pressed", !hidden.has(line)));
    chart.redraw();
    show();
  };
  // Beside the panel, where there is room for both.
  const place = () => {
    const { left, width } = document.getElementById("panel").getBoundingClientRect();
    box.style.right = width && left > 560 ? `${window.innerWidth - left + 12}px` : "";
  };
  const open = (given) => {
    plot = given;
    chart = kinds[plot.raster ? 1 : 0];
    hidden = new Set();
    heading.textContent = plot.unit ? `${plot.title} [${plot.unit}]` : plot.title;
    rows = plot.lines.map((line) => {
      const value = element("output"), row = element("button", { title: "show or hide" }, element("i"), element("span", {}, nameOf(line)), value);
      row.style.setProperty("--swatch", line.colour);
      row.addEventListener("click", () => { if (!hidden.delete(line)) hidden.add(line); refresh(); });
      return { row, line, value };
    });
    curves.replaceChildren(...rows.map(({ row }) => row));
    if (plot.lines.some((line) => line.reference.length)) curves.append(element("small", {}, "in brackets and pale: the reference"));
    if (plot.lines.some((line) => line.linear.length)) curves.append(element("small", { className: "dashed" }, "dashed: the linear model"));
    all.hidden = plot.lines.length < 3;
    box.hidden = false;
    place();
    refresh();
  };
  const csv = () => {
    const columns = [["t [s]", info.t]];
    for (const line of shown()) {
      const unit = plot.unit ? ` [${plot.unit}]` : "";
      columns.push([nameOf(line) + unit, line.values]);
      if (line.reference.length) columns.push([`${nameOf(line)} reference${unit}`, line.reference]);
      if (line.linear.length) columns.push([`${nameOf(line)} linear${unit}`, line.linear]);
    }
    const quoted = columns.map(([name]) => (/[",]/.test(name) ? `"${name.replaceAll('"', '""')}"` : name));
    const line = (_, i) => columns.map(([, values]) => Number(values[i].toPrecision(7))).join(",");
    return [quoted.join(","), ...Array.from(info.t, line)].join("\n") + "\n";
  };
  all.addEventListener("click", () => { hidden = new Set(hidden.size ? [] : plot.lines); refresh(); });
  close.addEventListener("click", () => { box.hidden = true; });
  save.addEventListener("click", () => {
    const url = URL.createObjectURL(new Blob([csv()], { type: "text/csv" }));
    element("a", { href: url, download: `${info.title} ${plot.title}.csv`.replace(/\W+(?!csv$)/g, "_") }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  });
  const point = (event) => {
    pointed = chart.under(event);
    chart.raise(pointed.line);
    if (event.buttons) seek(pointed.time);
    show();
  };
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); point(event); });
  canvas.addEventListener("pointermove", point);
  canvas.addEventListener("pointerleave", () => { pointed = null; chart.raise(null); show(); });
  window.addEventListener("resize", () => { place(); requestAnimationFrame(() => show()); });
  return { open, show };
}
