// roslibjs as a client of the rosbridge server at the URL given: does what it can, and prints what came of it as JSON.
import { Ros, Service, Topic } from "roslib";

const url = process.argv[2];
const LIMIT = 10_000;

const limited = (promise, what) =>
  Promise.race([
    promise,
    new Promise((_, fail) => setTimeout(() => fail(new Error(`no ${what}`)), LIMIT).unref()),
  ]);

const connect = () =>
  limited(
    new Promise((resolve, fail) => {
      const ros = new Ros({ url });
      ros.on("connection", () => resolve(ros));
      ros.on("error", fail);
    }),
    "connection",
  );

const call = (ros, name, serviceType, request, timeout) =>
  limited(
    new Promise((resolve) => {
      const service = new Service({ ros, name, serviceType });
      service.callService(request, resolve, (error) => resolve({ error }), timeout);
    }),
    `answer of ${name}`,
  );

// Two connections are served in no order: the offer may come after the call.
async function callWhenThere(...what) {
  const deadline = performance.now() + LIMIT;
  for (;;) {
    const answer = await call(...what);
    if (!answer.error || performance.now() > deadline) return answer;
    await new Promise((resolve) => setTimeout(resolve, 50));
  }
}

const subscription = (ros, options) => new Topic({ ros, messageType: "sensor_msgs/JointState", ...options });

const first = (topic) => limited(new Promise((resolve) => topic.subscribe(resolve)), `message of ${topic.name}`);

async function pingPong(ros) {
  const pong = new Topic({ ros, name: "/pong", messageType: "std_msgs/String" });
  const ping = new Topic({ ros, name: "/ping", messageType: "std_msgs/String" });
  const answer = first(pong);
  const timer = setInterval(() => ping.publish({ data: "from roslibjs: é€𝄞" }), 20);
  const message = await answer;
  clearInterval(timer);
  ping.unadvertise();
  pong.unsubscribe();
  return message.data;
}

async function compressed(ros, compression) {
  const topic = subscription(ros, { name: "/gripper/joint_states", compression });
  const message = await first(topic);
  topic.unsubscribe();
  return { name: message.name, position: Array.from(message.position), stamp: typeof message.header.stamp.sec };
}

async function throttled(ros) {
  const topic = subscription(ros, { name: "/gripper/joint_states", throttle_rate: 100, queue_length: 1 });
  const times = [];
  await limited(
    new Promise((resolve) => topic.subscribe(() => times.push(performance.now()) === 6 && resolve())),
    "6 messages",
  );
  topic.unsubscribe();
  return times[5] - times[0];
}

async function fragmented(ros) {
  const answer = limited(new Promise((resolve) => ros.on("/gripper/joint_states", resolve)), "fragments");
  const options = { topic: "/gripper/joint_states", type: "sensor_msgs/JointState", fragment_size: 50 };
  ros.callOnConnection({ op: "subscribe", id: "pieces", ...options });
  const message = await answer;
  ros.callOnConnection({ op: "unsubscribe", id: "pieces", topic: "/gripper/joint_states" });
  return message.msg.name;
}

async function provided(ros) {
  const service = new Service({ ros, name: "/roslibjs/flip", serviceType: "std_srvs/SetBool" });
  await service.advertise((request, response) => {
    response.success = !request.data;
    response.message = "flipped";
    return true;
  });
  const other = await connect();
  const answer = await callWhenThere(other, "/roslibjs/flip", "std_srvs/SetBool", { data: false });
  other.close();
  await service.unadvertise();
  return answer;
}

async function status(ros) {
  const answer = limited(new Promise((resolve) => ros.once("status", resolve)), "status");
  new Topic({ ros, name: "/joint_states", messageType: "std_msgs/String" }).subscribe(() => {});
  ros.callOnConnection({ op: "publish", topic: "/ping", msg: { data: 1 } });
  return (await answer).level;
}

const ros = await connect();
const results = {
  topics: await pingPong(ros),
  service: await call(ros, "/robot/set", "std_srvs/SetBool", { data: true }),
  unknown: await call(ros, "/nope", "std_srvs/Trigger", {}, 0.5),
  late: await call(ros, "/robot/slow", "std_srvs/Trigger", {}, 0.2),
  plain: await compressed(ros, "none"),
  cbor: await compressed(ros, "cbor"),
  png: await compressed(ros, "png"),
  throttled: await throttled(ros),
  fragmented: await fragmented(ros),
  provided: await provided(ros),
  status: await status(ros),
};
ros.close();
console.log(JSON.stringify(results));
process.exit(0);
