// The 3D view of this build.
import type { Stage, StageOptions } from "./stage/stage";

export const createStage: (options: StageOptions) => Stage = () => {
  throw new Error("this build of the page has no 3D view");
};
