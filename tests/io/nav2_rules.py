"""What the GeoJSON loader of nav2_route takes, as assertions."""


def nav2_metadata(values):
    """Metadata by the rules of the GeoJSON loader of nav2_route: no null, no array in an array."""
    for value in values.values():
        items = value if isinstance(value, list) else [value]
        for item in items:
            if isinstance(item, dict) and not isinstance(value, list):
                nav2_metadata(item)
            else:
                assert isinstance(item, bool | int | float | str), f"{item!r} is refused"
    return values


def nav2_graph(content):
    """Nodes and edges by id, read by the rules of nav2_route: an AssertionError is a refusal."""
    points = [f for f in content["features"] if f["geometry"]["type"] == "Point"]
    lines = [f for f in content["features"] if "LineString" in f["geometry"]["type"]]
    assert points and lines and len(points) + len(lines) == len(content["features"])
    nodes, edges = {}, {}
    for feature in points + lines:
        properties = feature["properties"]
        found = edges if feature in lines else nodes
        number = properties["id"]
        assert type(number) is int and 0 <= number < 2**32 and number not in nodes.keys() | edges
        found[number] = properties
        nav2_metadata(properties.get("metadata", {}))
        operations = properties.get("operations", {})
        for each in operations.values() if isinstance(operations, dict) else operations:
            assert isinstance(each["type"], str)
            assert each["trigger"] in ("NODE", "ON_ENTER", "ON_EXIT")
            nav2_metadata(each.get("metadata", {}))
    for properties in edges.values():
        assert {properties["startid"], properties["endid"]} <= nodes.keys()
        limit = properties["metadata"]["speed_limit"]
        # A number without a decimal point is an integer to the loader, and no float to its readers.
        assert isinstance(limit, float) and 0.0 < limit <= 100.0
    return nodes, edges
