// The 3-D view of a report: shapes in the poses of a replay, the plan as a ghost, contact forces, trails.
// It draws with three.js, whose text stands in the page and is only run when the view is first seen.
"use strict";
(() => {
  const figure = document.getElementById("view"), film = document.querySelector("video");
  if (!figure) return;
  const canvas = figure.querySelector("canvas"), probe = document.createElement("canvas");
  const movie = document.querySelector(".motion > figure:not(#view)"), name = film ? "Film" : "Picture";
  if (!(probe.getContext("webgl2"))) return;  // the page keeps its film, or the picture in its place

  const unpack = (text, Kind) => new Kind(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
  const data = JSON.parse(document.getElementById("view-data").textContent);
  const first = data.t[0], last = data.t[data.t.length - 1], frames = data.t.length;

  // Film, or a picture in its place, or view: one of them is seen.
  const tabs = Object.assign(document.createElement("p"), {className: "bar", id: "view-tabs"});
  let started = false;
  function show(which) {
    if (movie) movie.hidden = which !== name;
    figure.hidden = which === name;
    [...tabs.children].forEach(one => one.setAttribute("aria-pressed", one.textContent === which));
    if (!figure.hidden && film) film.pause();
    if (!figure.hidden && !started) { started = true; start(); }
  }
  if (movie) {
    for (const which of [name, "3-D view"]) {
      const button = Object.assign(document.createElement("button"), {type: "button", textContent: which});
      button.addEventListener("click", () => show(which));
      tabs.append(button);
    }
    movie.before(tabs);
  }
  show(film ? name : "3-D view");

  function start() {
    (0, eval)(document.getElementById("three").textContent + ";globalThis.THREE = THREE;");
    const T = globalThis.THREE, scene = new T.Scene(), eye = data.camera, span = eye.distance;
    const renderer = new T.WebGLRenderer({canvas, antialias: true, alpha: true});
    const camera = new T.PerspectiveCamera(eye.fovy, 16 / 9, 0.01 * span, 60 * span);
    scene.fog = new T.Fog(0xe9eef3, 4 * span, 25 * span);  // the middle of the background: floors have no edge
    camera.up.set(0, 0, 1);
    const controls = new T.OrbitControls(camera, canvas), rad = Math.PI / 180;
    let stale = true;  // what is drawn is no longer what is to be seen
    controls.addEventListener("change", () => { stale = true; });
    canvas.addEventListener("webglcontextrestored", () => { stale = true; });
    controls.listenToKeyEvents(canvas);  // arrows move, with Shift they turn
    function home() {
      const [az, el] = [eye.azimuth * rad, eye.elevation * rad];
      controls.target.set(...eye.target);
      camera.position.set(eye.target[0] - span * Math.cos(el) * Math.cos(az),
        eye.target[1] - span * Math.cos(el) * Math.sin(az), eye.target[2] - span * Math.sin(el));
      follow(now, true);
      controls.update();
    }
    const sky = new T.HemisphereLight(0xffffff, 0x9a9a9a, 2.2), lamp = new T.DirectionalLight(0xffffff, 1.4);
    sky.position.set(0, 0, 1);
    lamp.position.set(-0.6 * span, 0.8 * span, 0);  // over the reader's left shoulder: no side that he sees is black
    lamp.target.position.set(0, 0, -span);
    camera.add(lamp, lamp.target);
    scene.add(camera, sky);

    const up = new T.Vector3(0, 1, 0), vector = new T.Vector3();
    const colour = rgba => new T.Color().setRGB(rgba[0], rgba[1], rgba[2], T.SRGBColorSpace);
    function paint(rgba, flat = false, behind = false) {
      return new T.MeshStandardMaterial({color: colour(rgba), roughness: 0.65, metalness: 0, flatShading: flat,
        side: flat ? T.DoubleSide : T.FrontSide, transparent: rgba[3] < 1, opacity: rgba[3],
        depthWrite: rgba[3] > 0.5,
        polygonOffset: behind, polygonOffsetFactor: 2, polygonOffsetUnits: 16});  // the machine hides what coincides
    }
    const meshes = data.meshes.map(mesh => {
      const one = new T.BufferGeometry();
      one.setAttribute("position", new T.BufferAttribute(unpack(mesh.vertices, Float32Array), 3));
      one.setIndex(new T.BufferAttribute(unpack(mesh.triangles, Uint32Array), 1));
      one.computeVertexNormals();
      return one;
    });
    function geometry(shape) {
      const [a, b, c] = shape.size;
      if (shape.kind === "mesh") return meshes[shape.mesh];
      if (shape.kind === "box") return new T.BoxGeometry(2 * a, 2 * b, 2 * c);
      if (shape.kind === "sphere") return new T.SphereGeometry(a, 32, 16);
      if (shape.kind === "ellipsoid") return new T.SphereGeometry(1, 32, 16).scale(a, b, c);
      if (shape.kind === "capsule") return new T.CapsuleGeometry(a, 2 * c, 12, 24).rotateX(Math.PI / 2);
      if (shape.kind === "cylinder") return new T.CylinderGeometry(a, a, 2 * c, 32).rotateX(Math.PI / 2);
      return new T.PlaneGeometry(2 * (a || FAR), 2 * (b || FAR));
    }
    // A floor has squares in its colour, which tell how far something moves and where down is.
    const FAR = 30 * span, squares = new T.DataTexture(new Uint8Array([216, 194, 194, 216].flatMap(
      grey => [grey, grey, grey, 255])), 2, 2);
    squares.wrapS = squares.wrapT = T.RepeatWrapping;
    squares.colorSpace = T.SRGBColorSpace;
    squares.minFilter = T.LinearMipmapLinearFilter;  // in the distance their mean, or they would flicker
    squares.generateMipmaps = true;
    squares.anisotropy = 4;
    function pave(mesh, [a, b]) {
      const map = mesh.material.map = squares.clone(), side = span / 4;  // of two squares
      map.repeat.set(Math.round(2 * (a || FAR) / side) || 1, Math.round(2 * (b || FAR) / side) || 1);
      map.needsUpdate = true;
    }
    // One group of shapes for each body, of the machine and of its ghost.
    const bodies = [], ghosts = [], ghost = new T.Group();
    for (let i = 0; i < data.bodies; i++) {
      bodies.push(new T.Group());
      ghosts.push(new T.Group());
      scene.add(bodies[i]);
      ghost.add(ghosts[i]);
    }
    ghost.position.set(...data.ghost_offset);
    scene.add(ghost);
    const faint = data.ghost_colour.slice(0, 3).concat(Math.max(0.3, data.ghost_colour[3]));
    for (const shape of data.shapes) {
      const form = geometry(shape), flat = shape.kind === "mesh", [x, y, z, w, i, j, k] = shape.at;
      const put = (group, rgba) => {
        const mesh = new T.Mesh(form, paint(rgba, flat, rgba === faint));
        mesh.position.set(x, y, z);
        mesh.quaternion.set(i, j, k, w);
        if (shape.kind === "plane") pave(mesh, shape.size);
        group.add(mesh);
      };
      put(shape.body < 0 ? scene : bodies[shape.body], shape.colour);
      if (shape.ghost) put(ghosts[shape.body], faint);
    }
    const trails = new T.Group(), forces = new T.Group();
    for (const [points, rgba] of data.lines) {
      const path = new T.BufferGeometry().setFromPoints(points.map(p => new T.Vector3(...p)));
      trails.add(new T.Line(path, new T.LineBasicMaterial({color: colour(rgba)})));
    }
    if (data.goal_line.length) {
      const line = new T.BufferGeometry().setFromPoints(data.goal_line.map(p => new T.Vector3(...p)));
      trails.add(new T.Line(line, new T.LineBasicMaterial({color: 0x292b33})));
    }
    for (const place of data.goals) {
      const ball = new T.Mesh(new T.SphereGeometry(0.015 * data.size, 24, 12), paint([0.84, 0.06, 0.5, 1]));
      ball.position.set(...place);
      trails.add(ball);
    }
    for (let c = 0; c < data.contacts; c++) {
      const arrow = new T.Group(), red = paint([0.89, 0.12, 0.14, 1]);
      arrow.add(new T.Mesh(new T.CylinderGeometry(0.006 * span, 0.006 * span, 1, 12).translate(0, 0.5, 0), red));
      arrow.add(new T.Mesh(new T.ConeGeometry(0.015 * span, 0.04 * span, 16), red));
      forces.add(arrow);
    }
    scene.add(trails, forces);
    // A tendon is a chain of cylinders, one between each two of its points.
    const chain = (group, rgba) => one => {
      const links = [], look = paint(rgba || one.colour);
      for (let i = 1; i < one.points; i++) {
        links.push(new T.Mesh(new T.CylinderGeometry(one.width, one.width, 1, 12), look));
        group.add(links[i - 1]);
      }
      return {links, points: one.points, path: unpack(one.path, Float32Array)};
    };
    const tendons = data.tendons.map(chain(scene)).concat(data.ghost_tendons.map(chain(ghost, faint)));
    const from = new T.Vector3(), to = new T.Vector3();
    function stretch(frame) {
      for (const {links, points, path} of tendons) {
        links.forEach((link, i) => {
          from.fromArray(path, 3 * (frame * points + i));
          to.fromArray(path, 3 * (frame * points + i + 1));
          link.position.copy(from).add(to).multiplyScalar(0.5);
          to.sub(from);
          link.scale.y = Math.max(to.length(), 1e-9);
          link.quaternion.setFromUnitVectors(up, to.normalize());
        });
      }
    }

    const poses = unpack(data.poses, Float32Array), planned = unpack(data.ghost, Float32Array);
    const pushes = unpack(data.forces, Float32Array), shift = data.shift && unpack(data.shift, Float32Array);
    let now = 0, playing = false, before = 0, moved = new T.Vector3(), sized = false;
    function place(groups, values, frame) {
      groups.forEach((group, b) => {
        const at = 7 * (frame * data.bodies + b);
        group.position.set(values[at], values[at + 1], values[at + 2]);
        group.quaternion.set(values[at + 4], values[at + 5], values[at + 6], values[at + 3]);
      });
    }
    function follow(frame, anew) {
      if (!shift) return;
      if (anew) moved.set(0, 0, 0);
      vector.fromArray(shift, 3 * frame);
      const by = vector.clone().sub(moved);
      moved.copy(vector);
      camera.position.add(by);
      controls.target.add(by);
    }
    const slider = figure.querySelector("input"), words = figure.querySelector("output");
    function pose(frame) {
      now = Math.max(0, Math.min(frames - 1, frame));
      place(bodies, poses, now);
      place(ghosts, planned, now);
      stretch(now);
      forces.children.forEach((arrow, c) => {
        const at = 6 * (now * data.contacts + c), length = Math.hypot(...pushes.subarray(at + 3, at + 6));
        arrow.visible = length > 0.015 * span && Number.isFinite(pushes[at]);
        if (!arrow.visible) return;
        arrow.position.fromArray(pushes, at);
        arrow.quaternion.setFromUnitVectors(up, vector.fromArray(pushes, at + 3).normalize());
        arrow.children[0].scale.y = length;
        arrow.children[1].position.y = length;
      });
      follow(now, false);
      slider.value = now / Math.max(1, frames - 1);
      words.value = "t = " + data.t[now].toFixed(3) + " s";
      stale = true;
      if (!figure.hidden) document.dispatchEvent(new CustomEvent("planner-shown", {detail: data.t[now]}));
    }
    slider.addEventListener("input", () => { playing = false; pose(Math.round(slider.value * (frames - 1))); });

    const keys = figure.querySelector(".keys"), layers = [["ghost", ghost, true], ["trails and goals", trails,
      trails.children.length], ["contact forces", forces, data.contacts]];
    for (const [name, layer, there] of layers) {
      if (!there) continue;
      const label = document.createElement("label"), box = Object.assign(document.createElement("input"),
        {type: "checkbox", checked: true});
      box.addEventListener("change", () => { layer.visible = box.checked; stale = true; });
      label.append(box, " " + name + " ");
      keys.append(label);
    }
    const back = Object.assign(document.createElement("button"), {type: "button", textContent: "view of the film"});
    back.addEventListener("click", home);
    keys.append(back);
    const play = figure.querySelector("[data-do=play]");
    play.addEventListener("click", () => { playing = !playing; if (now === frames - 1) pose(0); });

    let clock = 0;
    function draw(time) {
      requestAnimationFrame(draw);
      if (figure.hidden) {
        stale = true;
        return;
      }
      const width = figure.clientWidth, height = Math.round(Math.min(width * 9 / 16, 0.72 * innerHeight));
      if (canvas.clientWidth !== width || canvas.clientHeight !== height || !sized) {
        sized = stale = true;
        renderer.setPixelRatio(Math.min(2, devicePixelRatio));
        renderer.setSize(width, height);
        camera.aspect = width / height;
        camera.updateProjectionMatrix();
      }
      clock = playing ? clock + data.speed * Math.min(0.1, (time - before) / 1000) : data.t[now] - first;
      before = time;
      if (playing) {
        if (clock > last - first) clock = 0;
        pose(Math.round(clock / ((last - first) || 1) * (frames - 1)));
      }
      play.textContent = playing ? "\u275a\u275a" : "\u25b6";
      controls.update();
      if (stale) renderer.render(scene, camera);
      stale = false;
    }
    document.addEventListener("planner-time", event => {  // a click on a curve
      playing = false;
      pose(Math.round((event.detail - first) / ((last - first) || 1) * (frames - 1)));
    });
    pose(0);
    home();
    playing = true;
    requestAnimationFrame(draw);
    globalThis.plannerView = {frames, pose: frame => { playing = false; pose(frame); },
      draw: () => renderer.render(scene, camera)};
  }
})();
