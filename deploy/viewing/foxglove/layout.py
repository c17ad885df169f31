"""A layout of Foxglove's panels that opens with our topics: map, camera, depth, regions as a table, notes, counts."""

from pathlib import Path

from foxglove import layouts as fl

from prior_sg.deploy.viewing.drawing import DARK
from prior_sg.deploy.viewing.foxglove.shapes import WORLD
from prior_sg.deploy.viewing.foxglove.stream import ABOVE, CALIBRATION, DEPTH, IMAGE, LAYERS, MAP, NOTES, PLACES, SCENE

HIDDEN = (*ABOVE, "unnamed", "frontiers")  # as on the live page
PLACE_PX, SURFACE_PX = 7.0, 2.0


def layout() -> fl.Layout:
    """The map on the left; camera, regions and notes on the right."""
    beside = [
        fl.SplitItem(proportion=4, content=_camera()),
        fl.SplitItem(proportion=3, content=_depth()),
        fl.SplitItem(proportion=3, content=_table()),
        fl.SplitItem(proportion=2, content=_counts()),
        fl.SplitItem(proportion=1, content=fl.LogPanel(title="Notes", config=fl.LogConfig(topic_to_render=NOTES))),
    ]
    content = fl.SplitContainer(
        direction="row",
        items=[
            fl.SplitItem(proportion=2, content=_map()),
            fl.SplitItem(proportion=1, content=fl.SplitContainer(direction="column", items=beside)),
        ],
    )
    return fl.Layout(content=content)


def save_layout(path: Path) -> None:
    """Write it for `Import layout from file`. Raises OSError."""
    path.write_text(layout().to_json() + "\n")


def _map() -> fl.ThreeDeePanel:
    topics: dict[str, fl.BaseRendererTopicSettings] = {
        f"/map/{name}": fl.BaseRendererSceneUpdateTopicSettings(visible=name not in HIDDEN) for name in LAYERS
    }
    for topic, size_px in ((PLACES, PLACE_PX), (MAP, SURFACE_PX)):
        topics[topic] = fl.BaseRendererPointCloudTopicSettings(
            visible=True, point_size=size_px, color_mode="rgba-fields"
        )
    return fl.ThreeDeePanel(
        title="Map",
        config=fl.ThreeDeeConfig(
            fixed_frame=WORLD,
            follow_tf=WORLD,
            follow_mode="follow-none",
            topics=topics,
            scene=fl.BaseRendererSceneSettings(background_color="#{:02x}{:02x}{:02x}".format(*DARK.background)),
            camera_state=fl.ThreeDeeCameraState(distance=18.0, phi=35.0, theta_offset=0.0, perspective=True),
        ),
    )


def _camera() -> fl.ImagePanel:
    """With the regions drawn into the picture."""
    mode = fl.ImageModeConfig(image_topic=IMAGE, calibration_topic=CALIBRATION)
    names = {"/map/objects": fl.BaseRendererSceneUpdateTopicSettings(visible=True)}
    return fl.ImagePanel(title="Camera", config=fl.ImageConfig(image_mode=mode, topics=dict(names)))


def _depth() -> fl.ImagePanel:
    mode = fl.ImageModeConfig(image_topic=DEPTH, calibration_topic=CALIBRATION)
    return fl.ImagePanel(title="Depth", config=fl.ImageConfig(image_mode=mode))


def _table() -> fl.TablePanel:
    return fl.TablePanel(title="Regions", config=fl.TableConfig(topic_path=f"{SCENE}.regions[:]"))


def _counts() -> fl.PlotPanel:
    series = [
        fl.PlotSeries(value=f"{SCENE}.places", label="places"),
        fl.PlotSeries(value=f"{SCENE}.regions.@length", label="regions"),
    ]
    return fl.PlotPanel(title="Counts", config=fl.PlotConfig(paths=list(series)))
