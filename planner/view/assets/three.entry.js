// What the 3-D view uses of three.js: `make assets` bundles it into three.min.js.
export {
  BoxGeometry, BufferAttribute, BufferGeometry, CapsuleGeometry, Color, ConeGeometry, CylinderGeometry, DataTexture,
  DirectionalLight, DoubleSide, Fog, FrontSide, Group, HemisphereLight, Line, LineBasicMaterial,
  LinearMipmapLinearFilter, Mesh, MeshStandardMaterial, PerspectiveCamera, PlaneGeometry, RepeatWrapping,
  SRGBColorSpace, Scene, SphereGeometry, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
