"""Scene files of 3D Slicer (MRML): nodes with attributes that refer to one another by id.

Source: what the node classes of github.com/Slicer/Slicer read (`ReadXMLAttributes` in Libs/MRML/Core, and
vtkMRMLSequenceBrowserNode).
"""

from __future__ import annotations

from xml.etree import ElementTree

VERSION = "Slicer4.4.0"
"""Version of the scene format, as in the scenes of Slicer's own tests."""


class SlicerScene:
    """A scene to write."""

    def __init__(self) -> None:
        self._root = ElementTree.Element("MRML", version=VERSION, userTags="")

    def add(
        self, tag: str, name: str, references: dict[str, str] | None = None, singleton: str = "", **attributes: str
    ) -> str:
        """Append a node and return its id.

        Args:
            tag: the node's class `vtkMRML...Node` without prefix and suffix.
            references: ids of other nodes, by role.
            singleton: tag of a node that replaces the one of the same class and tag in Slicer; its id ends in it.
        """
        number = singleton or str(len(self._root.findall(tag)) + 1)
        identity = f"vtkMRML{tag}Node{number}"
        if singleton:
            attributes["singletonTag"] = singleton
        if references:
            attributes["references"] = "".join(f"{role}:{other};" for role, other in references.items())
        ElementTree.SubElement(self._root, tag, {"id": identity, "name": name, **attributes})
        return identity

    def add_stored(
        self, kind: tuple[str, str], name: str, file: str, references: dict[str, str] | None = None, **attributes: str
    ) -> str:
        """Append a node whose data is in `file`, relative to the scene's own, in LPS axes; return its id.

        Args:
            kind: tags of the node and of its storage node.
        """
        tag, storage_tag = kind
        storage = self.add(storage_tag, "storage", fileName=file, coordinateSystem="LPS")
        return self.add(tag, name, {"storage": storage, **(references or {})}, **attributes)

    def file(self) -> bytes:
        """The .mrml file."""
        ElementTree.indent(self._root)
        return ElementTree.tostring(self._root, encoding="UTF-8", xml_declaration=True)
