"""Light of the sky and of the day, and the surroundings that a mirror reflects."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Extinction by molecules of air at sea level for red, green and blue, 1/m (Bucholtz, Rayleigh-scattering calculations
# for the terrestrial atmosphere, Applied Optics 34, 1995; 620, 550 and 460 nm).
MOLECULES = wp.constant(wp.vec3(7.2e-6, 11.6e-6, 24.2e-6))


@wp.struct
class Light:
    """Light of a view.

    Attributes:
        sun: Unit vector to the sun.
        sun_colour: Irradiance / pi of the sun, RGB.
        zenith: Light of the sky overhead.
        horizon: Light of the sky at the horizon.
        ground: Light from the ground.
        fog: Extinction, 1/m.
        clouds: 0 to 1.
        wet: 0 to 1.
        lamps: How far lamps are on, 0 to 1.
        turn: Offset of the clouds.
        haze: Extinction by haze, 1/m; 0 for air without any haze or molecules.
    """

    sun: wp.vec3
    sun_colour: wp.vec3
    zenith: wp.vec3
    horizon: wp.vec3
    ground: wp.vec3
    fog: float
    clouds: float
    wet: float
    lamps: float
    turn: float
    haze: float


@wp.func
def speck(x: int, y: int) -> float:
    """Return a fixed random number in [0, 1) for a cell."""
    bits = wp.uint32(x) * wp.uint32(374761393) + wp.uint32(y) * wp.uint32(668265263)
    bits = (bits ^ (bits >> wp.uint32(13))) * wp.uint32(1274126177)
    bits = bits ^ (bits >> wp.uint32(16))
    return float(bits & wp.uint32(65535)) / 65536.0


@wp.func
def cloudy(x: float, y: float) -> float:
    """Return smooth noise in [0, 1] with unit cells."""
    i = wp.floor(x)
    j = wp.floor(y)
    u = x - i
    v = y - j
    # Smoothstep: the noise has no visible creases at cell borders.
    u = u * u * (3.0 - 2.0 * u)
    v = v * v * (3.0 - 2.0 * v)
    column = int(i)
    row = int(j)
    lower = speck(column, row) * (1.0 - u) + speck(column + 1, row) * u
    upper = speck(column, row + 1) * (1.0 - u) + speck(column + 1, row + 1) * u
    return lower * (1.0 - v) + upper * v


@wp.func
def sky(light: Light, ray: wp.vec3, fine: int) -> wp.vec3:
    """Return the light from a direction of the sky (unit vector, world).

    fine: 0 for the gradient alone, 1 with clouds and the sun, 2 with clouds.
    """
    up = wp.max(ray[2], 0.0)
    zenith_share = wp.sqrt(up)
    colour = light.horizon * (1.0 - zenith_share) + light.zenith * zenith_share
    if fine >= 1 and ray[2] > 0.0:
        # a layer of clouds high above
        cloud_distance = 3.0 / (ray[2] + 0.12)
        x = ray[0] * cloud_distance + light.turn
        y = ray[1] * cloud_distance
        cloud_noise = cloudy(x, y) * 0.55 + cloudy(x * 2.3, y * 2.3) * 0.3 + cloudy(x * 5.1, y * 5.1) * 0.15
        cloud_share = wp.clamp((cloud_noise - 1.0 + light.clouds * 1.05) * 3.0, 0.0, 1.0) * wp.min(up * 8.0, 1.0)
        cloud_colour = light.horizon * 0.9 + light.sun_colour * 0.25
        colour = colour * (1.0 - cloud_share) + cloud_colour * cloud_share
        sun_cosine = wp.dot(ray, light.sun)
        if fine == 1 and sun_cosine > 0.9:
            glow = wp.pow(sun_cosine, 64.0) * 0.35 + wp.pow(sun_cosine, 2000.0) * 40.0
            colour = colour + light.sun_colour * glow * (1.0 - 0.9 * light.clouds)
    return colour


@wp.func
def surroundings(light: Light, ray: wp.vec3, p: wp.vec3, sharp: float) -> wp.vec3:
    """Return the light that a mirror at a point reflects from a direction (unit vector, world).

    Sky, houses up to a roof line, and the road. sharp: 1 for glass, less for a surface that blurs its image.
    """
    level = wp.max(wp.sqrt(ray[0] * ray[0] + ray[1] * ray[1]), 1.0e-4)
    slope = ray[2] / level
    if sharp * (slope - 0.5) > 0.25:
        return sky(light, ray, 0)
    x = ray[0] / level
    y = ray[1] / level
    skyline_noise = cloudy(x * 4.0 + p[0] * 0.04, y * 4.0 + p[1] * 0.04)
    roof_slope = 0.10 + 0.38 * skyline_noise
    houses = (light.horizon * 0.5 + light.zenith * 0.3 + light.sun_colour * 0.25) * (0.10 + 0.16 * skyline_noise)
    road = light.ground * 0.6
    sky_share = wp.clamp((slope - roof_slope) * 16.0 * sharp + 0.5, 0.0, 1.0)
    road_share = wp.clamp(0.5 - slope * 7.0, 0.0, 1.0)
    image = houses * (1.0 - road_share) + road * road_share
    if sky_share > 0.0:
        image = image * (1.0 - sky_share) + sky(light, ray, 0) * sky_share
    return image


@wp.func
def air_transmission(light: Light, distance: float) -> wp.vec3:
    """Return the share of the light, RGB, that fog and haze leave over a distance in m."""
    transmission = wp.vec3(1.0, 1.0, 1.0)
    if light.haze > 0.0:
        transmission = wp.vec3(
            wp.exp(-(light.haze + MOLECULES[0]) * distance),
            wp.exp(-(light.haze + MOLECULES[1]) * distance),
            wp.exp(-(light.haze + MOLECULES[2]) * distance),
        )
    if light.fog > 0.0:
        transmission = transmission * wp.exp(-light.fog * distance)
    return transmission
