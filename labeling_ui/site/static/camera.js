// Views of the pair scene that show both sides whole, whatever the shape of the window.

export const FIELD_OF_VIEW = 0.72; // rad, vertical; the recording sets the same

// What must stay in the picture, in metres of the recording (labeling_ui/replay.py): the corners of
// the table's used part with the letters, the robots' bases, and the highest point of the arms.
const TABLE = [
  [-0.98, -0.6, 0], [0.9, -0.6, 0], [-0.98, 0.44, 0], [0.9, 0.44, 0],
];
const ARMS = [[-0.95, 0, 0.72], [-0.3, 0.1, 0.7], [0.62, 0.1, 0.7]];

export const VIEWS = {
  front: { name: "Front", direction: [0, -0.62, 0.6], lookAt: [-0.02, -0.04, 0.12], keep: [...TABLE, ...ARMS] },
  top: { name: "Top", direction: [0, -0.03, 1], lookAt: [-0.02, -0.06, 0], keep: TABLE },
  low: { name: "Low", direction: [0, -0.93, 0.34], lookAt: [-0.02, -0.04, 0.2], keep: [...TABLE, ...ARMS] },
};

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
const unit = (a) => a.map((value) => value / Math.hypot(...a));

// Camera of a view for a window of the given shape (width / height): the nearest one along the
// view's direction from which everything in `keep` is inside the picture.
export function fitCamera(view, aspect) {
  const { direction, lookAt, keep } = VIEWS[view] ?? VIEWS.front;
  const back = unit(direction);
  const right = unit(cross([0, 0, 1], back));
  const up = cross(back, right);
  const vertical = Math.tan(FIELD_OF_VIEW / 2);
  const horizontal = vertical * aspect;
  let distance = 0;
  for (const point of keep) {
    const offset = point.map((value, axis) => value - lookAt[axis]);
    const depth = dot(offset, back);
    distance = Math.max(
      distance,
      depth + Math.abs(dot(offset, right)) / horizontal,
      depth + Math.abs(dot(offset, up)) / vertical,
    );
  }
  const position = lookAt.map((value, axis) => value + distance * 1.02 * back[axis]);
  return { position, lookAt };
}

// Where a point of the recording appears: x to the right and y up, both in -1 … 1 when visible.
export function project(point, camera, aspect) {
  const back = unit(camera.position.map((value, axis) => value - camera.lookAt[axis]));
  const right = unit(cross([0, 0, 1], back));
  const up = cross(back, right);
  const offset = point.map((value, axis) => value - camera.position[axis]);
  const depth = -dot(offset, back);
  const vertical = Math.tan(FIELD_OF_VIEW / 2) * depth;
  return { x: dot(offset, right) / (vertical * aspect), y: dot(offset, up) / vertical };
}

export function cameraParameters(camera) {
  const text = (point) => point.map((value) => value.toFixed(3)).join(",");
  return {
    initialCameraPosition: text(camera.position),
    initialCameraLookAt: text(camera.lookAt),
    initialCameraFov: String(FIELD_OF_VIEW),
  };
}
