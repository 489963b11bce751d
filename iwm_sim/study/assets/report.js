// Stacked time charts that share one time axis: hover or touch reads values, a drag or a pinch zooms, a double click
// shows everything again. The data stand beside each chart as JSON; the page asks nobody for anything.
"use strict";
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const LEFT = 54, RIGHT = 10, TOP = 8, PANEL = 132, AXIS = 36;

  const node = (parent, name, attributes = {}, text = null) => {
    const element = name === "svg" || parent.namespaceURI === SVG ? document.createElementNS(SVG, name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text !== null) element.textContent = text;
    parent.appendChild(element);
    return element;
  };

  // Steps of 1, 2 or 5 times a power of ten, about `count` of them.
  const ticks = (low, high, count) => {
    const raw = (high - low) / Math.max(1, count);
    const power = 10 ** Math.floor(Math.log10(raw));
    const step = power * [1, 2, 5, 10].find((m) => m * power >= raw * 0.999);
    const values = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k++) values.push(k * step);
    return { values, decimals: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
  };
  const format = (value, decimals) => value.toFixed(decimals).replace("-", "\u2212");

  // First index whose time is not before t.
  const search = (time, t) => {
    let low = 0, high = time.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (time[middle] < t) low = middle + 1; else high = middle;
    }
    return low;
  };

  // Path of one series: where several samples share a pixel column, its smallest and largest are both drawn.
  const path = (time, values, from, to, x, y, step) => {
    let d = "", pen = false, column = null, low = 0, high = 0, last = 0, lastY = null;
    const flush = () => {
      if (column === null) return;
      for (const value of last === low ? [high, low] : [low, high]) {
        const py = y(value).toFixed(1);
        if (step && pen && lastY !== py) d += `L${column.toFixed(1)} ${lastY}`;
        d += `${pen ? "L" : "M"}${column.toFixed(1)} ${py}`;
        pen = true; lastY = py;
        if (low === high) break;
      }
      column = null;
    };
    for (let i = from; i < to; i++) {
      const value = values[i];
      if (value === null) { flush(); pen = false; continue; }
      const px = x(time[i]);
      if (column !== null && px - column < 0.7) {
        if (value < low) low = value;
        if (value > high) high = value;
        last = value;
      } else {
        flush();
        column = px; low = high = last = value;
      }
    }
    flush();
    return d;
  };

  const extent = (panel, from, to) => {
    let low = Infinity, high = -Infinity;
    for (const series of panel.series) {
      for (let i = from; i < to; i++) {
        const value = series.values[i];
        if (value === null) continue;
        if (value < low) low = value;
        if (value > high) high = value;
      }
    }
    if (low > high) { low = 0; high = 1; }
    if (panel.limits) { low = Math.min(low, panel.limits[0]); high = Math.max(high, panel.limits[1]); }
    if (low === high) { const pad = Math.abs(low) * 0.05 || 1; low -= pad; high += pad; }
    const margin = 0.06 * (high - low);
    return [low - margin, high + margin];
  };

  const chart = (root) => {
    const data = JSON.parse(root.querySelector("script").textContent);
    const time = data.time, first = time[0], end = time[time.length - 1];
    const shortest = (end - first) / Math.max(20, time.length / 12);
    let view = [first, end], pointers = new Map(), pinch = null, drag = null, width = 0;
    const tools = node(root, "div", { class: "tools" });
    const all = node(tools, "button", { type: "button" }, "Whole drive");
    const hint = node(tools, "span", {}, matchMedia("(pointer: coarse)").matches
      ? "Touch to read values, pinch to zoom." : "Point to read values, drag to zoom, double-click to see everything.");

    const panels = data.panels.map((panel, index) => {
      const head = node(root, "div", { class: "head" });
      const axis = node(head, "span", { class: "axis" }, panel.label);
      if (panel.unit) node(axis, "span", { class: "unit" }, ", " + panel.unit);
      const now = panel.series.map((series) => {
        const key = node(head, "span", { class: "key" });
        const swatch = node(key, "svg", { viewBox: "0 0 22 10", "aria-hidden": "true" });
        node(swatch, "line", { x1: 1, x2: 21, y1: 5, y2: 5, style: `stroke:var(--c${series.colour});stroke-width:${series.wide ? 6 : 2};opacity:${series.wide ? 0.45 : 1}`, "stroke-dasharray": series.dashed ? "5 3" : "none" });
        node(key, "span", {}, series.name);
        return node(key, "span", { class: "now" });
      });
      const plot = node(root, "svg", { class: "plot", role: "img", "aria-label": `${panel.label} against time` });
      return { panel, plot, now, last: index === data.panels.length - 1 };
    });

    const x = (t) => LEFT + ((t - view[0]) / (view[1] - view[0])) * (width - LEFT - RIGHT);
    const timeAt = (px) => view[0] + ((px - LEFT) / (width - LEFT - RIGHT)) * (view[1] - view[0]);

    const draw = () => {
      width = root.clientWidth;
      if (width < 80) return;
      all.disabled = view[0] === first && view[1] === end;
      const from = Math.max(0, search(time, view[0]) - 1), to = Math.min(time.length, search(time, view[1]) + 1);
      const xTicks = ticks(view[0], view[1], (width - LEFT) / 70);
      for (const item of panels) {
        const { panel, plot, last } = item;
        const height = PANEL + TOP + (last ? AXIS : 6), bottom = TOP + PANEL;
        plot.replaceChildren();
        plot.setAttribute("viewBox", `0 0 ${width} ${height}`);
        plot.setAttribute("height", height);
        const [low, high] = extent(panel, from, to);
        const y = (value) => bottom - ((value - low) / (high - low)) * PANEL;
        const clip = `clip-${root.id}-${panels.indexOf(item)}`;
        node(node(node(plot, "defs"), "clipPath", { id: clip }), "rect", { x: LEFT, y: TOP - 2, width: width - LEFT - RIGHT, height: PANEL + 4 });
        for (const t of xTicks.values) {
          node(plot, "line", { class: "gridline", x1: x(t), x2: x(t), y1: TOP, y2: bottom });
          if (last) node(plot, "text", { class: "tick", x: x(t), y: bottom + 15, "text-anchor": "middle" }, format(t, xTicks.decimals));
        }
        const yTicks = panel.ticks.length ? { values: panel.ticks.map((t) => t[0]) } : ticks(low, high, 5);
        yTicks.values.forEach((value, k) => {
          if (value < low || value > high) return;
          node(plot, "line", { class: value === 0 ? "zero" : "gridline", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) });
          node(plot, "text", { class: "tick", x: LEFT - 7, y: y(value) + 4, "text-anchor": "end" }, panel.ticks.length ? panel.ticks[k][1] : format(value, yTicks.decimals));
        });
        const lines = node(plot, "g", { "clip-path": `url(#${clip})` });
        for (const series of panel.series) {
          node(lines, "path", { class: series.wide ? "series wide" : "series", d: path(time, series.values, from, to, x, y, series.step), style: `stroke:var(--c${series.colour});stroke-width:${series.wide ? 6 : 1.4}`, "stroke-dasharray": series.dashed ? "5 3" : "none" });
        }
        for (const [value, label] of panel.references) {
          if (value < low || value > high) continue;
          node(plot, "line", { class: "reference", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) });
          node(plot, "text", { class: "tick", x: width - RIGHT - 4, y: y(value) - 4, "text-anchor": "end" }, label);
        }
        if (last) node(plot, "text", { class: "tick", x: (LEFT + width - RIGHT) / 2, y: bottom + 31, "text-anchor": "middle" }, "Time, s");
        item.selection = node(plot, "rect", { class: "selection", y: TOP, height: PANEL, visibility: "hidden" });
        item.cursor = node(plot, "line", { class: "cursor", y1: TOP, y2: bottom, visibility: "hidden" });
      }
    };

    const read = (t) => {
      const inside = t !== null && t >= view[0] && t <= view[1];
      let k = inside ? search(time, t) : 0;
      if (inside && k > 0 && (k === time.length || t - time[k - 1] < time[k] - t)) k -= 1;
      hint.textContent = inside ? `t = ${format(time[k], 1)} s` : hint.dataset.rest;
      for (const { panel, now, cursor } of panels) {
        cursor.setAttribute("visibility", inside ? "visible" : "hidden");
        if (inside) { cursor.setAttribute("x1", x(time[k])); cursor.setAttribute("x2", x(time[k])); }
        panel.series.forEach((series, s) => {
          const value = inside ? series.values[k] : null;
          const named = panel.ticks.find((t) => t[0] === value);
          now[s].textContent = value === null ? "" : named ? named[1] : format(value, panel.decimals);
        });
      }
    };
    hint.dataset.rest = hint.textContent;

    const show = (low, high) => {
      let span = Math.min(end - first, Math.max(shortest, high - low));
      let start = Math.min(Math.max(first, (low + high - span) / 2), end - span);
      view = span >= (end - first) * 0.9999 ? [first, end] : [start, start + span];
      draw();
      read(null);
    };
    const select = (a, b) => panels.forEach(({ selection }) => {
      selection.setAttribute("visibility", a === null ? "hidden" : "visible");
      if (a !== null) { selection.setAttribute("x", Math.min(a, b)); selection.setAttribute("width", Math.abs(b - a)); }
    });
    const where = (event) => event.clientX - root.getBoundingClientRect().left;

    for (const { plot } of panels) {
      plot.addEventListener("pointerdown", (event) => {
        pointers.set(event.pointerId, where(event));
        if (pointers.size === 2) {
          const [a, b] = [...pointers.values()];
          pinch = { a: timeAt(Math.min(a, b)), b: timeAt(Math.max(a, b)) };
          drag = null; select(null);
        } else if (event.pointerType === "mouse" && event.button === 0) {
          drag = where(event);
          plot.setPointerCapture(event.pointerId);
        }
        read(timeAt(where(event)));
      });
      plot.addEventListener("pointermove", (event) => {
        if (pointers.has(event.pointerId)) pointers.set(event.pointerId, where(event));
        if (pinch && pointers.size === 2) {
          // Keep the two times under the two fingers.
          const [a, b] = [...pointers.values()].sort((p, q) => p - q);
          if (b - a < 12) return;
          const perPixel = (pinch.b - pinch.a) / (b - a), low = pinch.a - (a - LEFT) * perPixel;
          show(low, low + perPixel * (width - LEFT - RIGHT));
        } else {
          if (drag !== null) select(drag, Math.min(width - RIGHT, Math.max(LEFT, where(event))));
          read(timeAt(where(event)));
        }
      });
      const up = (event) => {
        pointers.delete(event.pointerId);
        if (pointers.size < 2) pinch = null;
        if (drag !== null) {
          const a = drag, b = where(event);
          drag = null; select(null);
          if (Math.abs(b - a) > 6) show(timeAt(Math.min(a, b)), timeAt(Math.max(a, b)));
        }
      };
      plot.addEventListener("pointerup", up);
      plot.addEventListener("pointercancel", up);
      plot.addEventListener("pointerleave", (event) => { if (drag === null) { pointers.delete(event.pointerId); read(null); } });
      plot.addEventListener("dblclick", () => show(first, end));
    }
    all.addEventListener("click", () => show(first, end));
    new ResizeObserver(() => { if (Math.abs(root.clientWidth - width) > 1) draw(); }).observe(root);
    draw();
  };

  document.querySelectorAll(".chart").forEach(chart);
})();
