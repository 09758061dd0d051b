// What the page uses of three.js and uPlot. library.min.js and library.css are made from it:
//   npm install three@0.187.0 uplot@1.6.32 esbuild@0.28.2
//   npx esbuild library.js --bundle --minify --format=iife --global-name=library \
//     --legal-comments=inline --target=es2020 --charset=utf8 --outfile=library.min.js
//   cp node_modules/uplot/dist/uPlot.min.css library.css
export {
  Box3, BoxGeometry, BufferGeometry, ConeGeometry, CylinderGeometry, DirectionalLight, EdgesGeometry,
  Float32BufferAttribute, Group, HemisphereLight, Line, LineBasicMaterial, LineSegments, Mesh,
  MeshBasicMaterial, MeshLambertMaterial, PerspectiveCamera, Quaternion, Scene, SphereGeometry, Vector3,
  WebGLRenderer,
} from 'three';
export { OrbitControls } from 'three/addons/controls/OrbitControls.js';
export { default as uPlot } from 'uplot';
