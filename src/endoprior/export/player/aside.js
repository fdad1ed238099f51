// Runs a function beside the page, in a worker, where the browser allows one; else here. One call at a time.

class Aside {
  // run: takes an argument and tell(share done), gives one or several typed arrays, or a promise of them
  // needed: other functions that it calls
  constructor(run, needed = []) {
    this.run = run;
    this.pending = null; // {argument, tell, resolve, reject}
    this.worker = this.startWorker([run, ...needed]);
  }

  startWorker(functions) {
    const source = `${functions.join("\n")}
      onmessage = async ({ data }) => {
        try {
          const result = await ${this.run.name}(data, (share) => postMessage({ share }));
          postMessage({ result }, [result].flat().map((values) => values.buffer));
        } catch (error) {
          postMessage({ problem: error.message });
        }
      };`;
    try {
      const address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
      const worker = new Worker(address);
      worker.onmessage = ({ data }) => {
        const { tell, resolve, reject } = this.pending;
        if (data.share) tell(data.share);
        else if (data.problem) reject(new Error(data.problem));
        else resolve(data.result);
      };
      worker.onerror = (event) => {
        event.preventDefault();
        if (this.worker) this.stopWorker();
      };
      return worker;
    } catch (error) {
      return null; // some browsers forbid workers in pages from disk
    }
  }

  stopWorker() {
    this.worker.terminate();
    this.worker = null;
    if (this.pending) this.runHere();
  }

  call(argument, tell = () => {}) {
    return new Promise((resolve, reject) => {
      const done = (act) => (value) => {
        this.pending = null;
        act(value);
      };
      this.pending = { argument, tell, resolve: done(resolve), reject: done(reject) };
      if (this.worker) this.worker.postMessage(argument);
      else this.runHere();
    });
  }

  async runHere() {
    const { argument, tell, resolve, reject } = this.pending;
    try {
      resolve(await this.run(argument, tell));
    } catch (error) {
      reject(error);
    }
  }
}
