"""Software renderer: triangles, camera, light and pixels, without a browser or a GPU."""
