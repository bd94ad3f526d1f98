"""The name of the scene frame, in its own module so that reading it loads no numerical library."""

#: The scene frame's name where nobody gives another one.
SCENE_FRAME = "csas_scene"
