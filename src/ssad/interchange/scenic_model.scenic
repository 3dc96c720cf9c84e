"""World model of SSAD for Scenic: the driving library's objects and actions, simulated by the embedded world.

Where a program names another model, this one takes its place (`ssad import scenic` does that), so that it runs
unchanged; a program of one's own says `model ssad.interchange.scenic_model`.

Global parameters:
    map (str): OpenDRIVE file of a town that SSAD knows by the file's name.
    time_step, timestep (float): only 0.1 s.
"""

from scenic.domains.driving.model import *

from ssad.interchange.scenic_world import ScenicWorld

param timestep = 0.1

simulator ScenicWorld(globalParameters.map, timestep=globalParameters.timestep)


class WorldObject(DrivingObject):
    """What is in the world: `category` is that of `ssad.simulators.carla.blueprints`."""
    category: "prop"
    blueprint: None

    def setPosition(self, pos, elevation):
        simulation().put_position(self, pos)

    def setVelocity(self, vel):
        simulation().put_velocity(self, vel)


class Vehicle(Vehicle, Steers, WorldObject):
    category: "car"

    def setThrottle(self, throttle):
        simulation().pedals(self).throttle = throttle

    def setSteering(self, steering):
        simulation().pedals(self).steer = -steering

    def setBraking(self, braking):
        simulation().pedals(self).brake = braking

    def setHandbrake(self, handbrake):
        simulation().pedals(self).handbrake = handbrake

    def setReverse(self, reverse):
        simulation().pedals(self).reverse = reverse


class Car(Vehicle):
    @property
    def isCar(self):
        return True


class NPCCar(Car):
    pass


class Truck(Vehicle):
    category: "truck"
    width: 2.5
    length: 8.47


class Van(Vehicle):
    category: "van"
    width: 2
    length: 5.2


class Bus(Vehicle):
    category: "bus"
    width: 2.5
    length: 10.27


class Motorcycle(Vehicle):
    category: "motorbike"
    width: 0.85
    length: 2.2


class Bicycle(Vehicle):
    category: "bicycle"
    width: 0.6
    length: 1.65


class Pedestrian(Pedestrian, WorldObject, Walks):
    category: "pedestrian"

    def setWalkingDirection(self, heading):
        simulation().walk(self, heading=heading)

    def setWalkingSpeed(self, speed):
        simulation().walk(self, speed=speed)


class Prop(WorldObject):
    """A thing on the road; CARLA's model has these names for it."""
    regionContainedIn: road
    position: new Point on road
    parentOrientation: Range(0, 360) deg
    width: 0.5
    length: 0.5


class Cone(Prop):
    width: 0.4
    length: 0.4


class Barrier(Prop):
    width: 0.5
    length: 1.5


class VendingMachine(Prop):
    width: 0.9
    length: 1.0


class Trash(Prop):
    pass


class Debris(Prop):
    pass


class Barrel(Prop):
    pass


class TrafficWarning(Prop):
    pass
