"""Scene graphs as Hydra makes them: by Spark-DSG, of the small world of rooms in a row."""

from datetime import timedelta

import numpy as np
import spark_dsg

from tests.help.world import ROOM_M, look

Symbol = spark_dsg.NodeSymbol


def hydra_graph(positions_m, edges, *, radius_m=0.5, stamp_ns=100, rooms=True, features=0):
    """Places with the room whose ground they stand on above them; rooms are called R0, R1 and so on."""
    graph = spark_dsg.DynamicSceneGraph()
    for index, position_m in enumerate(np.asarray(positions_m, float)):
        place = spark_dsg.PlaceNodeAttributes()
        place.position, place.distance, place.num_basis_points = position_m, radius_m, 3
        place.last_update_time_ns = stamp_ns
        if features:
            place.semantic_feature = np.ones((features, 1), np.float32)
        graph.add_node("PLACES", Symbol("p", index), place)
    for a, b in np.asarray(edges).tolist():
        graph.insert_edge(Symbol("p", a), Symbol("p", b), weight(0.4))
    if rooms:
        add_rooms(graph, positions_m)
    return graph


def add_rooms(graph, positions_m):
    numbers = (np.asarray(positions_m)[:, 0] // ROOM_M).astype(int).tolist()
    for number in sorted(set(numbers)):
        room = spark_dsg.RoomNodeAttributes()
        room.name = f"R{number}"
        graph.add_node("ROOMS", Symbol("R", number), room)
    for index, number in enumerate(numbers):
        graph.insert_edge(Symbol("R", number), Symbol("p", index))


def weight(clearance_m):
    attributes = spark_dsg.EdgeAttributes()
    attributes.weighted, attributes.weight = True, clearance_m
    return attributes


def add_object(graph, number, name, low_m, high_m):
    item = spark_dsg.ObjectNodeAttributes()
    low, high = np.array(low_m, float), np.array(high_m, float)
    item.position, item.name = (low + high) / 2, name
    item.bounding_box = spark_dsg.BoundingBox(high - low, (high + low) / 2)
    graph.add_node("OBJECTS", Symbol("O", number), item)


def add_agent(graph, number, stamp_s, position_m, heading_rad=0.0):
    """A pose of the robot in its partition, as Hydra keeps trajectories."""
    agent = spark_dsg.AgentNodeAttributes()
    agent.timestamp, agent.position = timedelta(seconds=stamp_s), np.array(position_m, float)
    agent.world_R_body = spark_dsg.Quaternion(np.cos(heading_rad / 2), 0.0, 0.0, np.sin(heading_rad / 2))
    graph.add_layer(2, ord("a"))
    graph.add_node(2, Symbol("a", number), agent, ord("a"))


def posed(keyframe, frame_id, stamp_s, x_m, y_m):
    """The keyframe's images from another place and time."""
    fields = {"frame_id": frame_id, "stamp_ns": int(stamp_s * 1e9), "world_from_camera": look(x_m, y_m, 0.0)}
    return type(keyframe)(**({name: getattr(keyframe, name) for name in keyframe.__struct_fields__} | fields))
