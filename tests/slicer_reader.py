"""Opens a .mrb file as 3D Slicer does, by what Slicer's source reads; shares nothing with the package's writer."""

from __future__ import annotations

import io
import json
import posixpath
import zipfile
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import trimesh


@dataclass(frozen=True)
class Node:
    """One node of a scene."""

    tag: str
    attributes: dict[str, str]
    references: dict[str, str]
    """Ids by role."""


class Bundle:
    """An archive: its main scene (the .mrml nearest to the root), and the files the scene names."""

    def __init__(self, data: bytes) -> None:
        self.archive = zipfile.ZipFile(io.BytesIO(data))
        assert self.archive.testzip() is None
        scenes = [name for name in self.archive.namelist() if name.endswith(".mrml")]
        self.main = min(scenes, key=lambda name: name.count("/"))
        elements = list(ElementTree.fromstring(self.archive.read(self.main)))
        self.nodes = {element.attrib["id"]: _node(element) for element in elements}
        assert len(self.nodes) == len(elements)
        for identity, node in self.nodes.items():
            number = identity.removeprefix(f"vtkMRML{node.tag}Node")
            assert number == node.attributes.get("singletonTag", number) != identity
            assert set(node.references.values()) <= self.nodes.keys()

    def only(self, tag: str) -> Node:
        """The one node of this class."""
        (node,) = (node for node in self.nodes.values() if node.tag == tag)
        return node

    def referenced(self, node: Node, role: str, tag: str) -> Node:
        """The node that `node` refers to."""
        found = self.nodes[node.references[role]]
        assert found.tag == tag
        return found

    def stored(self, node: Node, storage_tag: str) -> bytes:
        """The file of a node with storage; its name is relative to the scene."""
        storage = self.referenced(node, "storage", storage_tag)
        name = posixpath.join(posixpath.dirname(self.main), unquote(storage.attributes["fileName"]))
        return self.archive.read(name)

    def model(self, node: Node) -> trimesh.Trimesh:
        """The mesh of a model node in Slicer's world, RAS; the file and the node must agree on the axes."""
        data = self.stored(node, "ModelStorage")
        assert self.referenced(node, "storage", "ModelStorage").attributes["coordinateSystem"] == "LPS"
        assert b"\ncomment SPACE=LPS\n" in data.split(b"end_header")[0]
        mesh = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
        mesh.vertices = mesh.vertices * [-1, -1, 1]
        return mesh

    def markups(self, node: Node) -> tuple[np.ndarray, list[dict[str, Any]]]:
        """(P, 3) positions of a point list in Slicer's world, RAS, and its control points."""
        data = json.loads(self.stored(node, "MarkupsJsonStorage"))
        assert "markups-schema-v1." in data["@schema"]
        (found,) = data["markups"]
        assert f"Markups{found['type']}" == node.tag
        signs = {"LPS": [-1, -1, 1], "RAS": [1, 1, 1]}[found["coordinateSystem"]]
        return np.array([p["position"] for p in found["controlPoints"]]) * signs, found["controlPoints"]


def _node(element: ElementTree.Element) -> Node:
    rows = (entry.split(":") for entry in element.attrib.get("references", "").split(";") if entry)
    return Node(element.tag, dict(element.attrib), dict(rows))


def sequence_index(sequence: Node) -> dict[float, str]:
    """Ids of a sequence's data nodes, by the value of the index."""
    rows = (entry.split(":") for entry in sequence.attributes["indexValues"].split(";"))
    return {float(value): identity for identity, value in rows}


def vector(node: Node, name: str) -> np.ndarray:
    """Three numbers of an attribute."""
    values = np.array([float(x) for x in node.attributes[name].split()])
    assert values.shape == (3,)
    return values
