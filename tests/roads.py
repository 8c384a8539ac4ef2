"""A plain road as a net, for tests of what is read of nets; `b`, `c`: m, where these junctions lie."""

NET = """<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,{c},0" origBoundary="0,0,{c},0" projParameter="!"/>
  <edge id=":b_0" function="internal">
    <lane id=":b_0_0" index="0" speed="{speed}" length="0.1" shape="{b},-4.8 {b},-4.8"/>
    <lane id=":b_0_1" index="1" speed="{speed}" length="0.1" shape="{b},-1.6 {b},-1.6"/>
  </edge>
  <edge id="ab" from="a" to="b" priority="-1">
    <lane id="ab_0" index="0" speed="{speed}" length="{b}" shape="0,-4.8 {b},-4.8"/>
    <lane id="ab_1" index="1" speed="{speed}" length="{b}" shape="0,-1.6 {b},-1.6"/>
  </edge>
  <edge id="bc" from="b" to="c" priority="-1">
    <lane id="bc_0" index="0" speed="{speed}" length="{b}" shape="{b},-4.8 {c},-4.8"/>
    <lane id="bc_1" index="1" speed="{speed}" length="{b}" shape="{b},-1.6 {c},-1.6"/>
  </edge>
  <junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,-6.4"/>
  <junction id="b" type="priority" x="{b}" y="0" incLanes="ab_0 ab_1" intLanes=":b_0_0 :b_0_1"
            shape="{b},0 {b},-6.4">
    <request index="0" response="00" foes="00" cont="0"/>
    <request index="1" response="00" foes="00" cont="0"/>
  </junction>
  <junction id="c" type="dead_end" x="{c}" y="0" incLanes="bc_0 bc_1" intLanes="" shape="{c},-6.4 {c},0"/>
  <connection from="ab" to="bc" fromLane="0" toLane="0" via=":b_0_0" dir="s" state="M"/>
  <connection from="ab" to="bc" fromLane="1" toLane="1" via=":b_0_1" dir="s" state="M"/>
  <connection from=":b_0" to="bc" fromLane="0" toLane="0" dir="s" state="M"/>
  <connection from=":b_0" to="bc" fromLane="1" toLane="1" dir="s" state="M"/>
</net>"""


def two_lanes(middle: int, speed: str) -> str:
    """The net of a road from `ab` to `bc`: two lanes, `middle` m each edge, limited to `speed` m/s."""
    return NET.format(b=middle, c=2 * middle, speed=speed)
