// The parts of three.js that the page uses; tools/page/make.sh bundles them.
export {
  BufferGeometry, Color, Float32BufferAttribute, GridHelper, LineBasicMaterial, LineSegments,
  Matrix4, Mesh, MeshBasicMaterial, PerspectiveCamera, Points, PointsMaterial,
  QuadraticBezierCurve3, Raycaster, Scene, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
