"""URDF of a finger that slides, and of a box with a flap that it pushes."""

ARM = """<robot name="arm">
  <link name="root"/>
  <link name="finger">
    <collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.03 0.03"/></geometry></collision>
  </link>
  <joint name="slide" type="prismatic">
    <parent link="root"/><child link="finger"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" velocity="1" effort="9"/>
  </joint>
</robot>"""


def make_box(flap: float, upper: float) -> str:
    """Return the box, whose flap is at a place [m], and moves by up to a way [m]."""
    return f"""<robot name="box">
  <link name="wall"/>
  <link name="front">
    <collision><geometry><box size="0.02 0.4 0.3"/></geometry></collision>
  </link>
  <joint name="flap" type="prismatic">
    <origin xyz="{flap} 0 0.5"/><parent link="wall"/><child link="front"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="{upper}" velocity="1" effort="9"/>
  </joint>
</robot>"""
