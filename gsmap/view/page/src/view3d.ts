// The 3D view of the page; tests of the panels put one in its place that draws nothing.
export { createStage } from "./stage";
