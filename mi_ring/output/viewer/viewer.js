// The report's viewer: orbits a GLB under one point light, in units of the object's radius about its centre.
import {
  Group, LinearSRGBColorSpace, Matrix4, PerspectiveCamera, PointLight, Scene, Sphere, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

// What can be shown in place of radiance; roughness as the width of the distribution, the square of glTF's. Roughness and normals are plain numbers: sRGB's curve is undone.
const SHOWN = {
  diffuse: "diffuseColor.rgb",
  specular: "material.specularColorBlended",
  roughness: "sRGBTransferEOTF(vec4(vec3(roughnessFactor * roughnessFactor), 1.0)).rgb",
  normals: "sRGBTransferEOTF(vec4(transformNormalByInverseViewMatrix(normal, viewMatrix) * 0.5 + 0.5, 1.0)).rgb",
  unseen: "mix(vec3(1.0, 0.0, 1.0), outgoingLight, step(0.5, vSeen))",
};
const HALF_FIELD = 15; // of view [degrees]
const RADIANS = Math.PI / 180;

/** Near and far plane of a camera that has the unit ball in view, be it at the side. */
function planes(eye) {
  return [Math.max(0.01, (eye.length() - 1) / 2), eye.length() + 1];
}

/** Show `shown` of a material: "shaded", or a key of `SHOWN`. */
function show(material, shown) {
  material.onBeforeCompile = (shader) => {
    const end = "#include <opaque_fragment>";
    if (shown in SHOWN) shader.fragmentShader = shader.fragmentShader.replace(end, `outgoingLight = ${SHOWN[shown]};\n${end}`);
    if (shown !== "unseen") return;
    const [begin, varying] = ["#include <begin_vertex>", "varying float vSeen;\n"];
    shader.vertexShader = `attribute float _seen;\n${varying}${shader.vertexShader.replace(begin, `${begin}\nvSeen = _seen;`)}`;
    shader.fragmentShader = varying + shader.fragmentShader;
  };
  material.customProgramCacheKey = () => shown;
  material.needsUpdate = true;
}

/**
 * Fill a <figure> that has a <canvas> and, by name, the controls azimuth, elevation [degrees], brightness [stops] and show.
 * `glb`: an ArrayBuffer. `view`, in scene units: `up`, `eye` (the camera's place at the start) and `irradiance`, linear
 * RGB, that the light shall have at the centre. Returns a promise of the viewer's `draw`.
 */
async function open(figure, glb, view) {
  const canvas = figure.querySelector("canvas");
  const renderer = new WebGLRenderer({ canvas, antialias: true }); // sRGB, and no tone mapping, are its defaults
  const object = (await new GLTFLoader().parseAsync(glb, "")).scene;
  const [ball, materials] = [new Sphere().makeEmpty(), new Set()];
  object.updateMatrixWorld();
  object.traverse((part) => {
    if (!part.isMesh) return;
    part.geometry.computeBoundingSphere();
    ball.union(part.geometry.boundingSphere.clone().applyMatrix4(part.matrixWorld));
    materials.add(part.material);
  });
  const local = (point) => new Vector3(...point).sub(ball.center).divideScalar(ball.radius);
  // three.js takes no light to be nearer than 0.1: in units of the radius that does not matter.
  const unit = new Group().add(object);
  unit.scale.setScalar(1 / ball.radius);
  unit.position.copy(ball.center).divideScalar(-ball.radius);
  // Reflectances above 1 were scaled to fit into textures: the light makes up for it.
  const [{ userData }] = materials;
  const light = new PointLight(0xffffff, 1 / (userData.mi_ring?.scale ?? 1), 0, 2);
  const scene = new Scene().add(unit, light);

  const camera = new PerspectiveCamera(2 * HALF_FIELD);
  camera.up.set(...view.up);
  const eye = local(view.eye);
  const away = eye.length(); // of the light
  camera.position.copy(eye).setLength(1.05 / Math.sin(HALF_FIELD * RADIANS));
  const controls = new OrbitControls(camera, canvas);
  controls.minDistance = 1.2;
  controls.maxDistance = 20;
  controls.update();

  const control = (name) => figure.querySelector(`[name=${name}]`);
  const value = (name) => Number(control(name).value);

  function render() {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    renderer.setPixelRatio(window.devicePixelRatio);
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.fov = (2 / RADIANS) * Math.atan(Math.tan(HALF_FIELD * RADIANS) / Math.min(1, camera.aspect));
    [camera.near, camera.far] = planes(camera.position);
    camera.updateProjectionMatrix();
    const [a, e] = [value("azimuth") * RADIANS, value("elevation") * RADIANS];
    light.position.set(Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e));
    light.position.applyQuaternion(camera.quaternion).multiplyScalar(away);
    light.color.setRGB(...view.irradiance, LinearSRGBColorSpace).multiplyScalar(away ** 2 * 2 ** value("brightness"));
    renderer.render(scene, camera);
  }

  /**
   * Draw a photograph as Mitsuba would, and return it as a PNG's data URL. `to_world`: 16 numbers, row by row,
   * camera-to-world with x left, y up, z forward; fx, fy, cx, cy, width, height [px]; `light`: position and intensity.
   */
  function draw({ to_world, fx, fy, cx, cy, width, height, light: { position, intensity } }) {
    renderer.setPixelRatio(1);
    renderer.setSize(width, height, false);
    const one = new PerspectiveCamera();
    one.applyMatrix4(new Matrix4().set(...to_world).multiply(new Matrix4().makeScale(-1, 1, -1)));
    one.position.copy(local([to_world[3], to_world[7], to_world[11]]));
    const [near, far] = planes(one.position);
    one.projectionMatrix.set(
      (2 * fx) / width, 0, 1 - (2 * cx) / width, 0,
      0, (2 * fy) / height, (2 * cy) / height - 1, 0,
      0, 0, (near + far) / (near - far), (2 * near * far) / (near - far),
      0, 0, -1, 0,
    );
    one.projectionMatrixInverse.copy(one.projectionMatrix).invert();
    light.position.copy(local(position));
    light.color.setRGB(...intensity, LinearSRGBColorSpace).multiplyScalar(1 / ball.radius ** 2);
    renderer.render(scene, one);
    return canvas.toDataURL();
  }

  controls.addEventListener("change", render);
  figure.addEventListener("input", render);
  control("show").addEventListener("change", () => {
    for (const material of materials) show(material, control("show").value);
    render();
  });
  control("reset").addEventListener("click", () => {
    for (const name of ["azimuth", "elevation", "brightness"]) control(name).value = 0;
    controls.reset();
    render();
  });
  new ResizeObserver(render).observe(canvas);
  render();
  return { draw };
}

const data = (id) => document.getElementById(id).textContent;
const figure = document.getElementById("object");
if (document.createElement("canvas").getContext("webgl2")) {
  const glb = Uint8Array.from(atob(data("glb")), (character) => character.charCodeAt(0)).buffer;
  window.opened = open(figure, glb, JSON.parse(data("view"))).then((viewer) => (window.viewer = viewer));
} else {
  figure.textContent = "This browser draws no WebGL, which the view of the object needs; everything else is below.";
}
