"""Scene files to be refused in one sentence: file name -> (content, what the sentence says)."""

import json
import struct

SCENE = b'<scene version="3.0.0">%s</scene>'
BALL = b'<shape type="sphere"><point name="center" value="0, 0, 3"/>%s</shape>'
POSE = b'<sensor type="perspective"/>'
GREY = b'<bsdf type="diffuse" id="grey"/>'


def scene(body):
    return SCENE % (POSE + GREY + body)


def reflectance(tag, value):
    spectrum = b'<%s name="reflectance" value="%s"/>' % (tag, value)
    return scene(BALL % (b'<bsdf type="diffuse" id="paint">%s</bsdf>' % spectrum))


def names(file, kind=b"obj"):
    return scene(b'<shape type="%s"><string name="filename" value="%s"/></shape>' % (kind, file))


BOMB = (
    b'<?xml version="1.0"?><!DOCTYPE s [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">'
    b'<!ENTITY c "&b;&b;&b;&b;">]><scene version="3.0.0">&c;</scene>'
)
LEAK = b'<!DOCTYPE s [<!ENTITY x SYSTEM "file:///etc/hostname">]><scene version="3.0.0">&x;</scene>'
DEEP = b"<scene>" * 5000 + b"</scene>" * 5000
GROWING = (
    b'<scene version="3.0.0"><default name="a" value="%s"/>' % (b"x" * 4000)
    + b'<string name="f" value="$a$a$a$a"/>' * 4000
    + b"</scene>"
)

XML = {
    "empty.xml": (b"", "has 0 bytes"),
    "latin.xml": (SCENE % b"\xe9\xff", "is not text in UTF-8"),
    "binary.xml": (bytes(range(256)) * 8, "is not text in UTF-8"),
    "cut.xml": (scene(BALL % b"")[:-20], "is not well-formed XML"),
    "prose.xml": (b"Once upon a time", "is not well-formed XML"),
    "bomb.xml": (BOMB, "document type"),
    "leak.xml": (LEAK, "document type"),
    "deep.xml": (DEEP, "nests more than"),
    "growing.xml": (GROWING, "expand to more than"),
    "html.xml": (b"<html><body/></html>", "Mitsuba cannot load the scene|wanted a <scene>"),
    "shape.xml": (b'<shape version="3.0.0" type="sphere"/>', "wanted a <scene>"),
    "nothing.xml": (SCENE % POSE, "no shapes"),
    "no_pose.xml": (SCENE % (BALL % b""), "no sensor to take the pose from"),
    "loop.xml": (scene(b'<include filename="loop.xml"/>'), "includes more than"),
    "nested.xml": (scene(b'<shape type="sphere"><include filename="a.xml"/></shape>'), "include"),
    "outside.xml": (scene(b'<include filename="../other.xml"/>'), "inside its own folder"),
    "root.xml": (scene(b'<include filename="/etc/hostname"/>'), "inside its own folder"),
    "gone.xml": (scene(b'<include filename="gone/x.xml"/>'), "'gone/x.xml', which is not in"),
    "device.xml": (names(b"/dev/zero"), "inside its own folder"),
    "climbing.xml": (names(b"a/../../x.obj"), "inside its own folder"),
    "windows.xml": (names(b"C:\\x.obj"), "inside its own folder"),
    "folder.xml": (names(b"."), "which is not in"),
    "no_mesh.xml": (names(b"models/chair.obj"), "'models/chair.obj', which is not in"),
    "bad_mesh.xml": (names(b"index.ply", b"ply"), "index.ply has faces without vertices"),
    "bad_obj.xml": (names(b"index.obj"), "reference to invalid vertex"),
    "flat_mesh.xml": (names(b"points.ply", b"ply"), "found no triangles in points.ply"),
    "nan.xml": (reflectance(b"spectrum", b"nan"), "reflectance=nan of the material 'paint'"),
    "bright.xml": (reflectance(b"rgb", b"0.1, 1.5, 0.1"), "reflectance=1.5 of the material"),
    "negative.xml": (reflectance(b"float", b"-0.5"), "reflectance=-0.5 of the material"),
    "spectral.xml": (reflectance(b"spectrum", b"400:0.1, 700:7"), "reflectance=700:7"),
    "word.xml": (reflectance(b"rgb", b"red"), "Mitsuba cannot load the scene"),
    "plugin.xml": (scene(BALL % b'<bsdf type="velvet"/>'), 'Plugin "velvet" not found'),
    "unknown_ref.xml": (scene(BALL % b'<ref id="nope"/>'), 'unresolved reference to "nope"'),
    "unknown_name.xml": (scene(BALL % b'<float name="raduis" value="1"/>'), '"raduis"'),
    "inside.xml": (scene(b'<shape type="sphere"/>'), "the camera stands inside"),
    "behind.xml": (
        scene(b'<shape type="sphere"><point name="center" value="0, 0, -9"/></shape>'),
        "nothing",
    ),
    "no_size.xml": (scene(BALL % b'<float name="radius" value="nan"/>'), "no finite place"),
}

PLY = b"""ply
format ascii 1.0
element vertex %d
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 %s
3 0 1 %d
"""


def glb(corners=((0, 0, 0), (1, 0, 0), (0, 1, 0)), faces=((0, 1, 2),), *, count=0, view=0, mesh=0):
    """A binary glTF file; `count`, `view` and `mesh` break it."""
    places = b"".join(struct.pack("<3f", *corner) for corner in corners)
    indices = b"".join(struct.pack("<3I", *face) for face in faces)
    text = json.dumps({
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": mesh}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": view, "componentType": 5126, "count": count or len(corners),
             "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3 * len(faces), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(places)},
            {"buffer": 0, "byteOffset": len(places), "byteLength": len(indices)},
        ],
        "buffers": [{"byteLength": len(places + indices)}],
    }).encode()  # fmt: skip
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(places + indices), 0x004E4942) + places + indices
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")
NO_MESH = "found no triangles"
MESHES = {
    "index.ply": (PLY % (3, b"0", 99_999_999), "faces without vertices"),
    "minus.ply": (PLY % (3, b"0", -5), "faces without vertices"),
    "nan.ply": (PLY % (3, b"nan", 2), "not finite"),
    "claims.ply": (PLY % (4_000_000_000, b"0", 2), "too few or too many for the mesh it claims"),
    "points.ply": ((PLY % (3, b"0", 2)).replace(b"face 1", b"face 0"), NO_MESH),
    "point.ply": ((PLY % (3, b"0", 2)).replace(b"1 0 0\n0 1 0", b"0 0 0\n0 0 0"), "in one point"),
    "index.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999\n", NO_MESH),
    "minus.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -999999\n", NO_MESH),
    "claims.off": (b"OFF\n4000000000 1 0\n0 0 0\n", "too few or too many"),
    "index.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 77777777\n", "faces without vertices"),
    "claims.stl": (b"\0" * 80 + struct.pack("<I", 4_000_000_000) + b"\0" * 50, NO_MESH),
    "count.glb": (glb(count=300_000_000), NO_MESH),
    "view.glb": (glb(view=9), NO_MESH),
    "mesh.glb": (glb(mesh=7), NO_MESH),
    **{f"empty{s}": (b"", "has 0 bytes") for s in SUFFIXES},
    **{f"junk{s}": (bytes(range(256)) * 20, NO_MESH) for s in SUFFIXES},
}
