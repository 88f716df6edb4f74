// Plays one step of an environment as any client of a rack does: bam_msgs/GymAPI over roslibjs, nothing of ours.
// Arguments: the address, the service, the seed, the action as JSON. Prints what came back as JSON.
import { Ros, Service } from "roslib";

const [, , url, name, seed, action] = process.argv;
const [, STEP, RESET, CLOSE] = [0, 1, 2, 3];

const ros = new Ros({ url });
await new Promise((resolve, fail) => {
  ros.on("connection", resolve);
  ros.on("error", fail);
});

const service = new Service({ ros, name, serviceType: "bam_msgs/GymAPI" });

const ask = (request_type, fields) =>
  new Promise((resolve) => {
    const header = { client_id: "roslibjs", request_type };
    service.callService({ header, env_name: "Pick", ...fields }, resolve, (error) => resolve({ error }), 20);
  });

const answers = {
  unasked: await ask(STEP, { action: [] }),
  reset: await ask(RESET, { seed: Number(seed) }),
  step: await ask(STEP, { action: [{ action_type: 1, continuous_action: JSON.parse(action) }] }),
  close: await ask(CLOSE, {}),
};
ros.close();
console.log(JSON.stringify(answers));
process.exit(0);
