// The parts of three.js that the page uses; tools/page/make.sh bundles them.
export {
  AmbientLight, BoxGeometry, BufferGeometry, Color, ConeGeometry, DirectionalLight, EdgesGeometry,
  Float32BufferAttribute, GridHelper, Group, Line, LineBasicMaterial, LineSegments, Mesh,
  MeshBasicMaterial, MeshLambertMaterial, PerspectiveCamera, Points, PointsMaterial,
  QuadraticBezierCurve3, Quaternion, Raycaster, Scene, TubeGeometry, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
