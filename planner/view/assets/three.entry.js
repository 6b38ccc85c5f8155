// What the 3-D view uses of three.js: `make assets` bundles it into three.min.js.
export {
  BoxGeometry, BufferAttribute, BufferGeometry, CapsuleGeometry, Color, ConeGeometry, CylinderGeometry,
  DirectionalLight, DoubleSide, FrontSide, GridHelper, Group, HemisphereLight, Line, LineBasicMaterial, Mesh,
  MeshStandardMaterial, PerspectiveCamera, PlaneGeometry, SRGBColorSpace, Scene, SphereGeometry, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
