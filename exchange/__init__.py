"""Scans as files: what other programs read and write. -> protocol

    formats     the one place to start: which suffix is which format, read and write by it
    mesh        the triangles of a grid, a band of rows at a time; glb, ply, obj, stl write them
    native      the grid itself as .npz, read and written without loss
    mesh_file   triangles of anybody's mesh, or its points; cast (along rays) and points turn them into a grid
    echo        Cyberware Echo range images
    closing     a cylinder as a sphere, by profile and ends, with other sweeps of the object laid on it by fit
    unrolling   a sphere as a cylinder; star: a closed mesh as a sphere
    image, whole_file, errors

Node, client and simulators share it; it knows none of them, nor any wire.
"""
