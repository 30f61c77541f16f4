// A three.js scene on black, and a camera where the page's address says.
import * as THREE from "three";

export const query = new URLSearchParams(location.search);
const vector = (name) => new THREE.Vector3(...query.get(name).split(",").map(Number));
export const renderer = new THREE.WebGLRenderer({ antialias: false });
renderer.setSize(innerWidth, innerHeight);
document.body.append(renderer.domElement);
export const camera = new THREE.PerspectiveCamera(Number(query.get("fov")), innerWidth / innerHeight, 0.01, 1000);
camera.up.copy(vector("up"));
camera.position.copy(vector("eye"));
camera.lookAt(vector("target"));
camera.updateMatrixWorld();
export const scene = new THREE.Scene();
scene.background = new THREE.Color(0);
