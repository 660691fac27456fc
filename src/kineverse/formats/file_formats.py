"""The file formats: endings of file names, readers and writers."""

from __future__ import annotations

from kineverse.model.registry import FileFormat

from .xml_reader import read_root_tag

DOCUMENT_SUFFIXES = (".kv.json", ".kv.msgpack")
USD_SUFFIXES = (".usda", ".usdc", ".usd")


def is_mjcf(name: str, content: bytes) -> bool:
    """Return whether a file is MJCF, which shares the ending ``.xml`` with URDF."""
    return name.endswith(".mjcf") or (name.endswith(".xml") and read_root_tag(content).startswith("mujoco"))


def _is_urdf(name: str, content: bytes) -> bool:
    return name.endswith((".urdf", ".xml")) and not is_mjcf(name, content)


def list_file_formats() -> tuple[FileFormat, ...]:
    """Return all formats; of those that read the same file, the first one counts."""
    formats = "kineverse.formats"
    return (
        *(
            FileFormat(
                name=f"document ({suffix})",
                suffixes=(suffix,),
                read=f"{formats}.document.reader:document_entries",
                written=(suffix,),
                write=f"{formats}.document.writer:write_document",
                exact=True,
            )
            for suffix in DOCUMENT_SUFFIXES
        ),
        FileFormat(
            name="URDF",
            suffixes=(".urdf", ".xml"),
            read=f"{formats}.urdf.operations:urdf_file_operations",
            written=(".urdf",),
            write=f"{formats}.urdf.writer:to_urdf",
            engine=f"{formats}.engines:PinocchioEngine",
            recognize=_is_urdf,
        ),
        FileFormat(
            name="MJCF",
            suffixes=(".xml", ".mjcf"),
            read=f"{formats}.mjcf.operations:mjcf_file_operations",
            written=(".xml", ".mjcf"),
            write=f"{formats}.mjcf.writer:to_mjcf",
            engine=f"{formats}.engines:MujocoEngine",
            recognize=is_mjcf,
            loop_element="equality",
            reference=b"file",
        ),
        FileFormat(
            name="SDF",
            suffixes=(".sdf", ".world"),
            read=f"{formats}.sdf.operations:sdf_file_operations",
            written=(".sdf",),
            write=f"{formats}.sdf.writer:to_sdf",
            engine=f"{formats}.engines:DrakeEngine",
            loop_element="joint",
            reference=b"include",
        ),
        FileFormat(
            name="USD",
            suffixes=USD_SUFFIXES,
            read=f"{formats}.usd.operations:usd_file_operations",
            written=USD_SUFFIXES,
            write=f"{formats}.usd.writer:to_usd",
            engine=f"{formats}.usd.kinematics:UsdEngine",
            loop_element="joint",
        ),
        FileFormat(
            name="PartNet-Mobility",
            suffixes=("mobility_v2.json",),
            read=f"{formats}.partnet.operations:partnet_file_operations",
            folder_file="mobility_v2.json",
            reference=b"[",  # meshes are named by result.json beside it
        ),
        FileFormat(
            name="xacro",
            suffixes=(".xacro",),
            read=f"{formats}.xacro:xacro_file_operations",
            loop_element="joint",
            reference=b"<",
        ),
    )
