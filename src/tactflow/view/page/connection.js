// The WebSocket to the run: decodes messages, and reconnects after a loss.

const DELAYS = [0.3, 0.7, 1.5, 3, 5];  // back-off between attempts, s; the last value repeats
const WRONG_TOKEN = 4401;

export class Connection {
  // on: { open, text(message), frame(header, blob, heights), lost(secondsToNextAttempt), refused }
  constructor(token, on) {
    this.on = on;
    this.attempt = 0;
    this.token = token;
    this.connect();
  }

  connect() {
    clearTimeout(this.timer);
    const query = this.token ? `?token=${encodeURIComponent(this.token)}` : "";
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/live${query}`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) => {
      if (typeof event.data === "string") {
        const message = JSON.parse(event.data);
        if (message.type === "hello") {
          this.attempt = 0;
          this.on.open();
        }
        this.on.text(message);
      } else {
        this.on.frame(...decode(event.data));
      }
    };
    socket.onclose = (event) => {
      if (this.socket !== socket) return;
      this.socket = null;
      if (event.code === WRONG_TOKEN) {
        this.on.refused();
      } else {
        const delay = DELAYS[Math.min(this.attempt++, DELAYS.length - 1)];
        this.timer = setTimeout(() => this.connect(), delay * 1000);
        this.on.lost(delay);
      }
    };
    this.socket = socket;
  }

  // Reconnect now, if waiting.
  retryNow() {
    if (this.socket === null) this.connect();
  }

  useToken(token) {
    this.token = token;
    this.retryNow();
  }

  send(message) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }
}

// Format: little-endian length of the header, JSON header, heights of a surface (optional), JPEG picture.
function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const pixels = 4 + length + (header.surface?.bytes ?? 0);
  const heights = header.surface?.bytes ? new Uint16Array(buffer.slice(4 + length, pixels)) : null;
  return [header, new Blob([new Uint8Array(buffer, pixels)], { type: "image/jpeg" }), heights];
}
