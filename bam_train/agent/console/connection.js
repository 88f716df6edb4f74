// The socket of the agent: the token first, requests with answers, events; opened again whenever it closes.

const QUIET = 3000; // time without a message after which the connection counts as lost [ms]
const REFUSED = 1008; // close code for a client without a right token
const ASKED = "This robot asks for a token.";

export class Connection {
  // on: {open, lost(reason), event(message), token(reason)} or some of them; `token` asks for a token, for `enter`.
  constructor(path, on) {
    this.url = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path}`;
    this.on = { open() {}, lost() {}, token() {}, ...on };
    this.waiting = new Map();
    this.number = 0;
    this.wantsToken = false;
    this.refused = false;
    this.ready = false;
    this.heard = 0;
    this.delay = 250;
    setInterval(() => this.look(), 500);
    this.open();
  }

  open() {
    const socket = new WebSocket(this.url);
    this.refused = this.shown = false;
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    this.heard = performance.now();
    socket.onmessage = (message) => this.take(message.data);
    socket.onclose = (end) => {
      if (socket === this.socket) this.close(end.code, end.reason);
    };
  }

  take(data) {
    this.heard = performance.now();
    if (typeof data !== "string") {
      this.on.event(data);
      return;
    }
    const message = JSON.parse(data);
    if (message.event === "auth") {
      this.wantsToken = true;
      const token = sessionStorage.getItem("token");
      if (token) this.show(token);
      else this.on.token(ASKED);
      return;
    }
    if (!this.ready) { // the server has let this page in: it says hello
      this.ready = true;
      this.delay = 250;
      this.on.open();
    }
    const waiting = this.waiting.get(message.id);
    if (waiting === undefined) {
      this.on.event(message);
    } else if (message.progress === undefined) {
      this.waiting.delete(message.id);
      if (message.ok) waiting.resolve(message.result);
      else waiting.reject(Object.assign(new Error(message.error), { kind: message.kind }));
    }
  }

  enter(token) {
    sessionStorage.setItem("token", token);
    if (this.socket.readyState === WebSocket.OPEN) this.show(token);
    this.again();
  }

  show(token) {
    this.shown = true;
    this.heard = performance.now();
    this.socket.send(JSON.stringify({ op: "auth", token }));
  }

  // Open it again if it closed for want of a token, which is there now.
  again() {
    if (this.refused) this.open();
  }

  close(code, reason) {
    this.ready = false;
    for (const { reject } of this.waiting.values()) reject(new Error("The connection closed before the answer."));
    this.waiting.clear();
    this.on.lost(reason);
    this.refused = code === REFUSED;
    if (this.refused) {
      this.wantsToken = true;
      if (this.shown) sessionStorage.removeItem("token");
      this.on.token(this.shown ? reason || "The token is wrong." : ASKED);
      return; // `enter` opens it again
    }
    setTimeout(() => this.open(), this.delay);
    this.delay = Math.min(2000, 2 * this.delay);
  }

  look() {
    if (this.socket.readyState > WebSocket.OPEN || performance.now() - this.heard < QUIET) return;
    if (this.wantsToken && !this.shown) return; // a person types
    const socket = this.socket;
    this.socket = { readyState: WebSocket.CLOSED };
    socket.close();
    this.close(0, `nothing was heard for ${QUIET / 1000} s`);
  }

  // Whether the message was handed to the network.
  send(message) {
    if (!this.ready || this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(typeof message === "string" ? message : JSON.stringify(message));
    return true;
  }

  request(op, fields = {}) {
    const id = ++this.number;
    const name = sessionStorage.getItem("person") || "console";
    return new Promise((resolve, reject) => {
      this.waiting.set(id, { resolve, reject });
      if (!this.send({ id, op, name, ...fields })) {
        this.waiting.delete(id);
        reject(new Error("There is no connection to the robot."));
      }
    });
  }
}
