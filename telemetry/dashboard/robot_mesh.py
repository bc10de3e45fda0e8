"""A robot's body, as its URDF file shows it."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr

from telemetry.dashboard.canvas import Canvas
from telemetry.picture import SiteView, UrdfView

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_WORLD: Final = "tf#/"

# By the component that a visual geometry comes with: what gives it the site's colour.
_COLOURED: Final[dict[str, Any]] = {
    "Asset3D:blob": lambda colour: rr.Asset3D.from_fields(albedo_factor=colour),
    "Boxes3D:half_sizes": lambda colour: rr.Boxes3D.from_fields(colors=colour, fill_mode="solid"),
    "Cylinders3D:lengths": lambda colour: rr.Cylinders3D.from_fields(
        colors=colour, fill_mode="solid"
    ),
    "Ellipsoids3D:half_sizes": lambda colour: rr.Ellipsoids3D.from_fields(
        colors=colour, fill_mode="solid"
    ),
    "Capsules3D:lengths": lambda colour: rr.Capsules3D.from_fields(
        colors=colour, fill_mode="solid"
    ),
}


class RobotMesh:
    """The visual geometry of one site's URDF, in the site's colour, moved by its joint angles.

    What cannot be read is left out and named in `problems`: the arm's lines are drawn anyway.
    """

    def __init__(self, canvas: Canvas, view: SiteView, urdf: UrdfView) -> None:
        self.problems: list[str] = []
        self._canvas = canvas
        self._root = f"mesh_{view.name}"
        self._joints = list(urdf.joint_names)
        self._tree: rr.urdf.UrdfTree | None = None
        try:
            tree = rr.urdf.UrdfTree.from_file_path(
                urdf.path, entity_path_prefix=self._root, frame_prefix=f"{view.name}/"
            )
            shown = self._log_geometry(tree, view)
        except Exception as error:  # rerun's own kinds vary from release to release
            self.problems.append(f"{view.name} robot is drawn as lines, {urdf.path.name}: {error}")
            return
        if shown:
            self._tree = tree
            self._log_still(tree, view)

    def draw(self, times_ns: IntArray, q_rows: FloatArray) -> None:
        """Draw the robot at joint angles (k, n) [rad]."""
        if self._tree is None:
            return
        count, joints = q_rows.shape
        # All joints on one entity, one row each: an entity a joint would cost as many times more.
        moved = self._tree.compute_joint_transform_batches(
            pa.array([self._joints] * count), pa.array(q_rows.tolist())
        ).flatten()
        columns = rr.Transform3D.columns(
            translation=moved.field("translation").flatten().to_numpy().reshape(-1, 3),
            quaternion=moved.field("quaternion").flatten().to_numpy().reshape(-1, 4),
            parent_frame=moved.field("parent_frame").to_pylist(),
            child_frame=moved.field("child_frame").to_pylist(),
        )
        self._canvas.send(f"{self._root}/joints", np.repeat(times_ns, joints), columns)

    def _log_geometry(self, tree: rr.urdf.UrdfTree, view: SiteView) -> bool:
        """Log the visual geometry; whether there is any."""
        links = [tree.root_link().name] + [joint.child_link for joint in tree.joints()]
        visuals = {path: link for link in links for path in tree.get_visual_geometry_paths(link)}
        found: dict[str, str] = {}
        for chunk in tree.stream(include_joint_transforms=False):
            if chunk.entity_path in visuals:  # and not what is only there for collisions
                self._canvas.send_chunks([chunk])
                for component in chunk.to_record_batch().schema.names:
                    if component in _COLOURED:
                        found[chunk.entity_path] = component
        for path, component in found.items():
            self._canvas.log_static(path, _COLOURED[component](view.colour))
        lacking = {visuals[path] for path in visuals.keys() - found.keys()}
        if lacking:
            self.problems.append(
                f"{view.name} robot is drawn without the mesh of {', '.join(sorted(lacking))}: "
                "its file cannot be read"
            )
        return bool(found)

    def _log_still(self, tree: rr.urdf.UrdfTree, view: SiteView) -> None:
        """Log where the base stands, and the joints that this robot does not move."""
        base = rr.Transform3D(
            parent_frame=_WORLD, child_frame=f"{view.name}/{tree.root_link().name}"
        )
        self._canvas.log_static(self._root, base)
        for number, joint in enumerate(tree.joints()):
            if joint.name not in self._joints:
                still = joint.compute_transform(0.0, clamp=False)
                self._canvas.log_static(f"{self._root}/still/{number}", still)
