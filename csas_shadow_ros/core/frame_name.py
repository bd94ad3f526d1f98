"""The name of the scene frame: apart, as who only asks for it loads no numerical library."""

#: The scene frame's name where nobody gives another one.
SCENE_FRAME = "csas_scene"
